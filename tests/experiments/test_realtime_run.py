"""What a run on a simulated arm says of the arm itself, whose true shape is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from apcc_torch.experiments import realtime_run
from apcc_torch.hardware.simulated.world import SimulatedWorld
from composed import composed_realtime

# One sensor at the tip of three sections, and no law: the model fits there, and is 30 mm off the arm elsewhere.
QUICK = (
    "experiment=setpoint", "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.1", "loop.hold=0.0",
    "figures=false", "loop.warm_up=3", "loop.fresh_frames=1", "view=false", "compile=off", "experiment.duration=0.6",
    "arm.sensors=[0.6]", "divergence.shape=0.04", "controller.adaptive=false",
)  # fmt: skip


def test_a_model_that_fits_at_the_sensors_alone_has_diverged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, metrics = realtime_run.run(composed_realtime(*QUICK), tmp_path)
    assert metrics["diverged_rows"] == 1.0 and "1 of 1 rows diverged: row 0 from" in caplog.text
    assert "(shape error)" in caplog.text
    monkeypatch.setattr(SimulatedWorld, "true_coordinates", lambda world, sequence: None)
    _, metrics = realtime_run.run(composed_realtime(*QUICK), tmp_path)
    assert metrics["diverged_rows"] == 0.0, "the sensors say nothing of it"
