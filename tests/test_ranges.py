"""No setting takes what has no meaning: whatever is tried is refused by the field's name, or is within its range."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import Field, fields
from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch import AdaptiveLaw, APCCController, Arm, SoftArmDynamics, StateFeedback, decouple, shape_error
from apcc_torch.annotations import numbers_in
from apcc_torch.errors import ApccError
from apcc_torch.lie import se3, so3
from apcc_torch.reading import plain, read
from apcc_torch.settings import Settings, about_of
from every_class import needed, settings_classes

HUGE = 10**400
TRIED: tuple[Any, ...] = (
    *(True, math.nan, math.inf, -math.inf, -1, -1.0, 0, 1e300, -1e300, HUGE, 3j, "guessed", b"x", object()),
    *([1], [], [True], ["a"], [[1]], [math.nan], (math.inf,), {"a": 1}, torch.tensor(True), torch.tensor(math.nan)),
)
BARE = {
    "dict[str,ComparisonSettings]",
    "dict[str,PairSettings]",
    "Mapping[str,Any]",
    "Mapping[str,list[str]]",
    "Any",
    "bool|str",
}
"""Types of values that are checked entry by entry, or where they are used."""


def refused(name: str, make: Callable[[], object]) -> bool:
    """Whether it is refused, by short sentences, each in a line of its own, of which one names the field."""
    try:
        make()
    except ApccError as error:
        said = str(error).splitlines()
        assert any(name in line for line in said) and all(0 < len(line) < 1000 for line in said), said
        return True
    return False


def own_fields(kind: type[Settings]) -> list[Field[Any]]:
    """The fields that a class does not have from another."""
    return [each for each in fields(kind) if each.name in inspect.get_annotations(kind)]


@pytest.mark.parametrize("kind", settings_classes(), ids=lambda kind: kind.__name__)
def test_what_has_no_meaning_is_refused_by_name(kind: type[Settings]) -> None:
    given = needed(kind)
    for each in own_fields(kind):
        about = about_of(each)
        for value in TRIED:
            if refused(each.name, lambda value=value, each=each: kind(**{**given, each.name: value})):  # type: ignore[misc]
                continue
            about.check(each.name, value)
            numbers = list(numbers_in(value))
            assert about.infinite or all(abs(number) < math.inf for number in numbers), (each.name, value)
            assert not isinstance(value, bool) or each.type == "bool" or str(each.type).replace(" ", "") in BARE
        if not about.key:
            continue
        for value in (math.nan, math.inf, HUGE, True, "guessed", [math.nan], {"qqqq": 1}):
            values = {**{name: plain(settings) for name, settings in given.items()}, each.name: value}
            if not refused(each.name, lambda v=values: read(v, kind, "at")):  # type: ignore[misc]
                assert about.infinite or not isinstance(value, float), (each.name, value)


def test_every_number_has_a_range_or_is_finite() -> None:
    """What is a number of any sign is listed here: a new one says its range, or joins."""
    of_any_sign = {
        *(
            "ExperimentSettings.r_0",
            "ExperimentSettings.A",
            "PruneSettings.above",
            "InverseKinematicsSettings.null_bends",
        ),
        *(
            "GuardSettings.slack_effort",
            "CommandLimitSettings.lower",
            "CommandLimitSettings.upper",
            "RampSettings.goal",
        ),
        *("ReplaySettings.direction", "ReplaySettings.forward", "ReplaySettings.base_position"),
        *("CompositeControllerSettings.lower", "CompositeControllerSettings.upper", "MocapSettings.base_offset"),
        *("PressureLimitSettings.lower", "PressureLimitSettings.upper"),
        *("Placement.position", "Placement.rotation", "Placement.gravity", "Actuation.pulls", "Actuation.pre_stretch"),
        # Positive definite gains, which the class checks.
        *("AdaptiveLawSettings.gamma", "NormalisedLawSettings.gamma", "InverseKinematicsSettings.K"),
    }
    numeric = {"float", "int", "Setting", "Numbers", "Lengths", "Range", "tuple[float,...]", "tuple[int,...]"}
    without = {
        f"{kind.__name__}.{each.name}"
        for kind in settings_classes()
        for each in own_fields(kind)
        if numeric & set(str(each.type).replace(" ", "").split("|")) and about_of(each).range == "finite"
    }
    assert without == of_any_sign


ARM = Arm(lengths=[0.2, 0.25])
CONTROLLER = APCCController.for_arm(ARM)
D = torch.float64
Q, LENGTHS, V, T = (
    torch.zeros(6, dtype=D),
    ARM.rest_lengths(),
    torch.zeros(3, dtype=D),
    torch.eye(4, dtype=D).expand(2, 4, 4),
)
DYNAMICS: SoftArmDynamics = ARM.dynamics()
BACKBONE, ROUTING = CONTROLLER.backbone, ARM.routing()
FEEDBACK: StateFeedback = CONTROLLER.feedback
CALLS: dict[str, tuple[Callable[..., Any], dict[str, Tensor]]] = {
    "tip": (BACKBONE.tip, {"q": Q, "L0": LENGTHS}),
    "tip_jacobian": (BACKBONE.tip_jacobian, {"q": Q, "L0": LENGTHS}),
    "tip_jacobian_rate": (BACKBONE.tip_jacobian_rate, {"q": Q, "qdot": Q, "L0": LENGTHS}),
    "regressor": (BACKBONE.regressor, {"q": Q, "qdot": Q}),
    "pose": (BACKBONE.pose, {"q": Q, "L0": LENGTHS, "X_tilde": V[:2], "j": torch.tensor([0, 1])}),
    "decouple": (decouple, {"X": LENGTHS, "L0": LENGTHS}),
    "shape_error": (shape_error, {"points": T[..., :3, 3], "reference": T[..., :3, 3]}),
    "feedback": (FEEDBACK, {"q": Q, "pi_hat": LENGTHS, "T": T}),
    "inverse_kinematics": (
        CONTROLLER.inverse_kinematics,
        {"J": torch.ones(3, 6, dtype=D), "e": V, "xdot_d": V, "q": Q},
    ),
    "law": (AdaptiveLaw(2), {"pi_hat": LENGTHS, "Y": torch.ones(3, 2, dtype=D), "e": V, "dt": V[0]}),
    "initial_state": (CONTROLLER.initial_state, {"q": Q, "pi_hat": LENGTHS}),
    "tendons": (CONTROLLER.tendons, {"q": Q, "pi_hat": LENGTHS}),
    "matrix": (ROUTING.matrix, {"pi_hat": LENGTHS}),
    "lengths": (ROUTING.lengths, {"q": Q, "pi_hat": LENGTHS}),
    "generalized_force": (ROUTING.generalized_force, {"u": torch.zeros(6, dtype=D), "pi_hat": LENGTHS}),
    "inertia": (DYNAMICS.inertia, {"q": Q}),
    "coriolis": (DYNAMICS.coriolis, {"q": Q, "qdot": Q}),
    "forward": (DYNAMICS, {"q": Q, "qdot": Q, "tau": Q}),
    "so3_exp": (so3.exp, {"w": V}),
    "so3_right_jacobian": (so3.right_jacobian, {"w": V}),
    "se3_right_jacobian": (se3.right_jacobian, {"twist": Q}),
    "se3_log": (se3.log, {"T": T}),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_tensor_of_numbers_is_refused_by_the_arguments_name(name: str) -> None:
    call, arguments = CALLS[name]
    call(*arguments.values())
    for argument in arguments:
        for value in (1, 1.5, True, None, [1.0, 2.0], "x", torch.tensor([True]), 3j):
            with pytest.raises(ApccError, match=r"must (be|have)") as caught:
                call(*{**arguments, argument: value}.values())
            assert "\n" not in str(caught.value)
