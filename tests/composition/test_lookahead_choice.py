"""`lookahead` becomes the controller that it describes, everywhere that can look, and is refused elsewhere."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import with_dynamics
from apcc_torch.composition.export import parts
from apcc_torch.control.ahead import AheadStatus
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.dynamic import simulate
from apcc_torch.viewing.pursuit import Pursuit
from composed import composed, composed_export

Q, PI = torch.zeros(9, dtype=torch.float64), torch.tensor([0.105, 0.255, 0.24], dtype=torch.float64)
FEW = ("lookahead=mppi", "lookahead.samples=4", "lookahead.steps=2", "plant.settle=0.1", "progress=false")


@pytest.mark.parametrize(("adaptation", "pieces"), [("shape", 6), ("none", 3)])
def test_the_model_has_the_pieces_that_the_estimator_knows(adaptation: str, pieces: int) -> None:
    config = composed("experiment=dynamic_run_2", "lookahead=mppi", "lookahead.samples=32", f"adaptation={adaptation}")
    controller = Builder(config).controller()
    assert isinstance(controller, LookaheadController) and controller.lookahead.samples == 32
    assert controller.lookahead.loop.dynamics.n_sections == pieces
    plain = Builder(composed("experiment=dynamic_run_2")).controller()
    assert type(plain) is APCCController and plain.initial_state(Q, PI).ahead is None


def test_a_simulation_looks_ahead_before_every_step_but_the_first() -> None:
    one = ("experiment=dynamic_single", "experiment.duration=0.04", "adaptation=none")
    looked, plain = simulate(composed(*one, *FEW)), simulate(composed(*one, "plant.settle=0.1", "progress=false"))
    assert torch.equal(looked.log.q_d[0], plain.log.q_d[0])
    assert (looked.log.q_d[1:] != plain.log.q_d[1:]).any(-1).any()


def test_the_viewer_looks_ahead() -> None:
    pursuit = Pursuit(composed("experiment=dynamic_single", "adaptation=none", *FEW))
    pursuit.step()
    pursuit.step()
    status = pursuit.now.controller.ahead.status  # type: ignore[union-attr]
    assert (status != AheadStatus.NONE).all()


def test_what_cannot_look_ahead_says_so() -> None:
    both = Builder(composed("experiment=dynamic_run_2_composite", "lookahead=mppi"))
    with pytest.raises(ConfigError, match="lookahead must be none beside dynamics_law: its rollouts know no feed"):
        with_dynamics(both, both.controller())
    with pytest.raises(ConfigError, match="lookahead must be none in an exported library: it holds no rollouts"):
        parts(composed_export("arm=arm_1").changed(lookahead=LookaheadSettings()))


def test_a_library_takes_settings_of_its_own_class() -> None:
    control = ControlSettings().with_keys({"lookahead": LookaheadSettings(horizon=0.2)})
    assert control.lookahead == LookaheadSettings(horizon=0.2)
    with pytest.raises(ConfigError, match="lookahead is none"):
        ControlSettings().with_keys({"lookahead": {"horizon": 0.2}})
