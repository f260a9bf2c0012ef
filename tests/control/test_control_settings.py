"""What a controller is made of: changes by name reach the group that has them, and the shipped one takes any arm."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.control.control_settings import ControllerKeys, ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.shape_law import ShapeLaw
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.task_integral import TaskIntegralSettings
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.pose_filter import PoseFilterSettings
from apcc_torch.estimation.state_feedback_settings import StateFeedbackSettings
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm

D = torch.float64
TWO = Arm(lengths=[0.2, 0.25], mass=0.4)
FIVE = Arm(lengths=[0.1, 0.12, 0.1, 0.09, 0.11], base="standing", mass=0.4)
PLAIN = ControlSettings()


def test_a_key_reaches_the_first_group_that_has_it() -> None:
    keys = {"K": 2.0, "velocity": "commanded", "mode": "position", "angular_weight": 0.1, "window": 9}
    keys |= {"upper": 1.2, "time_constant": 3.0, "damping": 1e-2, "rate": 50.0}
    changed = PLAIN.with_keys(keys)
    assert changed.controller == ControllerKeys(K=2.0, velocity="commanded", damping=1e-2, rate=50.0)
    assert changed.feedback == StateFeedbackSettings(mode="position", angular_weight=0.1)
    assert changed.velocity_filter.window == 9 and changed.bounds.upper == 1.2
    assert changed.adaptation == ShapeLaw.settings_type(time_constant=3.0), "the others have none of that name"
    assert ControlSettings() == PLAIN, "what it was made from stays"
    assert PLAIN.with_keys({}) == PLAIN


def test_a_group_takes_settings_a_mapping_or_none() -> None:
    own = StateFeedbackSettings(max_iterations=3)
    assert PLAIN.with_keys({"feedback": own}).feedback == own
    assert PLAIN.with_keys({"feedback": {"max_iterations": 3}}).feedback == own
    assert PLAIN.with_keys({"adaptation": None}).adaptation is None
    law = {"adaptation": {"time_constant": 1.0, "refine": 3}}
    assert PLAIN.with_keys(law).adaptation == ShapeLaw.settings_type(time_constant=1.0, refine=3)
    assert PLAIN.with_keys({"pose_filter": {"angular_time": 0.1}}).pose_filter == PoseFilterSettings(angular_time=0.1)
    integral = PLAIN.with_keys({"integral": {}}).integral
    assert integral == TaskIntegralSettings()
    # A key after its group changes the group that was handed in.
    later = PLAIN.with_keys({"adaptation": AdaptiveLaw.settings_type(regressor="partial"), "gamma": 3.0})
    assert later.adaptation == AdaptiveLaw.settings_type(regressor="partial", gamma=3.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"null_gian": 1.0}, r"a controller has no setting 'null_gian'; did you mean null_gain\?"),
        ({"feedbak": {}}, r"no setting 'feedbak'; did you mean feedback\?"),
        ({"feedback": {"modes": "pose"}}, r"StateFeedback has no setting 'modes'; did you mean mode\?"),
        (
            {"pose_filter": {"angular_tim": 0.1}},
            r"PoseFilter has no setting 'angular_tim'; did you mean angular_time\?",
        ),
        ({"adaptation": None, "gamma": 1.0}, "no setting 'gamma'"),
        ({"adaptation": None, "time_constant": 1.0}, "no setting 'time_constant'"),
        ({"mode": "poses"}, "mode must be one of position, pose, hierarchical"),
        ({"window": 2.5}, "window must be a whole number, got 2.5"),
    ],
)
def test_what_is_unknown_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PLAIN.with_keys(changes)


def test_what_is_out_of_range_is_refused() -> None:
    with pytest.raises(ValueRangeError, match=r"null_gain must be zero or positive and finite, got -1.0"):
        APCCController.for_arm(TWO, null_gain=-1.0)
    none = PLAIN.with_keys({"adaptation": None})
    with pytest.raises(ConfigError, match="adaptation is none, and only its settings say of which class"):
        none.with_keys({"adaptation": {"time_constant": 1.0}})


def stepped(controller: APCCController, arm: Arm, rows: int = 3, **target: Any) -> Any:
    """State and command after a few steps of arms that bend, and are a little longer than the model."""
    model, lengths = controller.backbone, 1.02 * arm.rest_lengths().expand(rows, -1)
    q = model.coordinates.per_unit(0.3, 0.002, model.n, torch.zeros((), dtype=D)).expand(rows, -1)
    aim = Target(model.tip(q, lengths), torch.zeros(rows, 3, dtype=D), **target)
    state, command = controller.initial_state(torch.zeros_like(q), arm.rest_lengths()), None
    for k in range(1, 6):
        T = model.pose(0.1 * k * q, lengths, *decouple(arm.sensor_places(), lengths))
        state, command = controller(state, Measurement(T, torch.tensor(0.02 * k, dtype=D)), aim)
    return state, command


@pytest.mark.parametrize("arm", [TWO, FIVE], ids=["two sections", "five sections"])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {
            "mode": "position",
            "adaptation": NormalisedLaw.settings_type(),
            "gamma": ("along", 90.0, 42.5, 35.0),
            "null_weights": ("along", 1.0, 2.0),
        },
        {"adaptation": AdaptiveLaw.settings_type(gamma=5.0, regressor="partial"), "reach": "each"},
        {
            "adaptation": NormalisedLaw.settings_type(),
            "model": AffineBackbone.settings_type(rods=1),
            "pose_filter": {"angular_time": 0.05},
            "integral": {"gain": 0.5},
        },
    ],
    ids=["shipped", "positions, profiles", "theorem 1", "affine, filtered, integral"],
)
def test_the_controller_of_any_arm_steps(arm: Arm, changes: dict[str, Any]) -> None:
    controller = APCCController.for_arm(arm, **changes)
    assert torch.equal(controller.backbone.base_rotation, arm.base_rotation())
    assert controller.backbone.n_sections == arm.n_sections
    assert torch.equal(controller.feedback.abscissae, arm.sensor_places())
    assert controller.bounds is not None and controller.bounds.least is not None
    torch.testing.assert_close(controller.bounds.least, 0.2 * arm.rest_lengths())
    state, command = stepped(controller, arm)
    assert command.y is not None and command.y.shape == (3, arm.n_tendons)
    assert bool(state.pi_hat.isfinite().all()) and bool(command.q_d.isfinite().all()) and bool(command.y.any())
    assert (state.pi_hat != arm.rest_lengths()).any()
    assert len(state.memories) == len(controller.laws) == 1
    assert (controller.shape is None) == ("adaptation" in changes)


def test_without_laws_the_lengths_stay() -> None:
    controller = APCCController.for_arm(TWO, adaptation=None)
    state, _ = stepped(controller, TWO)
    assert len(controller.laws) == 0 and torch.equal(state.pi_hat, TWO.rest_lengths().expand(3, 2))


def test_bounds_are_relative_to_the_arm() -> None:
    nominal = TWO.rest_lengths() * torch.tensor([[1.1, 0.9], [1.0, 1.2]], dtype=D)
    bounds = APCCController.on(TWO, PLAIN, nominal).bounds
    assert bounds is not None and bounds.largest is not None
    torch.testing.assert_close(bounds.largest, 5.0 * TWO.rest_lengths())


def test_the_controller_of_tasks_is_made_alike() -> None:
    controller = TaskController.on(TWO, PLAIN.with_keys({"K": 2.0}), tasks=[Task("orientation")])
    assert isinstance(controller, TaskController) and controller.sensors == [1]
    state, command = stepped(controller, TWO, tasks=(TaskTarget(R_d=TWO.base_rotation()),))
    assert bool(state.q_d.isfinite().all()) and bool(command.qdot.any())
    assert isinstance(TaskController.for_arm(TWO), TaskController)
