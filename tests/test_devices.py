"""Nothing is left behind on the CPU: the loop runs whole on another device.

The device is torch's `meta`, which has shapes but no values and is everywhere: an operation that mixes devices, or
reads a value to decide, fails on it as it would stall or fail on an accelerator.
"""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.model.abscissae import decouple
from composed import changed

META = torch.device("meta")


@pytest.fixture(autouse=True)
def as_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    # Early exits read a value; a compiled step goes on instead, and so does this one.
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)


@pytest.mark.parametrize("experiment", ["dynamic_run_1", "dynamic_run_2", "kinematic"])
def test_the_control_step_stays_on_its_device(experiment: str) -> None:
    controller = Builder(changed(experiment)).controller().to(META)
    q, pi = torch.zeros(4, 9, dtype=torch.float64, device=META), torch.ones(4, 3, dtype=torch.float64, device=META)
    state = controller.initial_state(q, pi)
    T = torch.zeros(4, 3, 4, 4, dtype=torch.float64, device=META)
    x = torch.zeros(4, 3, dtype=torch.float64, device=META)
    for _ in range(2):
        state, command = controller(state, Measurement(T, state.time), Target(x, x))
    assert command.y is not None and command.y.device == META and command.y.shape == (4, 9)
    assert state.pi_hat.device == META


def test_the_plant_stays_on_its_device() -> None:
    plant = Builder(changed("dynamic_run_2")).plant(torch.zeros(4, dtype=torch.float64))
    arm = plant.dynamics.to(META)
    q = torch.zeros(4, 18, dtype=torch.float64, device=META)
    payload = torch.zeros(4, dtype=torch.float64, device=META)
    assert arm(q, q, q, payload).device == META
    X_tilde, j = decouple(torch.tensor([0.1, 0.3], dtype=torch.float64, device=META), arm.lengths)
    assert plant.backbone.to(META).pose(q, arm.lengths, X_tilde, j).shape == (4, 2, 4, 4)
