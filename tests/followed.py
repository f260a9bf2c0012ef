"""The small arm of `parts` with its shape known from mechanics: the estimator, the fit, the feedback, and calls."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.shape_law import ShapeLaw
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback
from parts import WHERE, backbone, controller, dynamics, feedback, lengths, number, numbers, poses, q, routing, sensors
from parts import some as drawn


def loaded(**given: Any) -> LoadedShape:
    """Of sections in two pieces each."""
    of = {
        "lengths": lengths() / 2.0,
        "masses": numbers(0.1, 0.15),
        "axial_stiffness": numbers(100.0, 80.0),
        "bending_stiffness": numbers(0.8, 0.6),
    }
    pieces = dynamics(**{name: value.repeat_interleave(2) for name, value in of.items()})
    return LoadedShape(pieces, routing(), given.pop("abscissae", sensors()), **given)


def fit(**given: Any) -> ArcFit:
    return ArcFit(backbone(), given.pop("nominal", lengths()), **given)


def followed(**given: Any) -> ShapeFeedback:
    return ShapeFeedback(loaded(), fit(**given))


def led(**given: Any) -> APCCController:
    """A controller with the law of the shape."""
    of = feedback(max_iterations=1, min_iterations=1)
    return controller(feedback=of, laws=ShapeLaw(lengths(), of, **given), shape=followed())


def seen(*rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sensor poses, what of them counts, tendon lengths, one of them unknown, and the time of a step."""
    counts = torch.ones(*rows, 3, dtype=torch.bool, **WHERE)
    y = drawn(*rows, 6, seed=4, scale=2e-3) / numbers(1.0, 1.0, 0.0, 1.0, 1.0, 1.0)
    return poses(*rows), counts, counts, y, number(0.02).expand(rows).clone()


def hung(of: LoadedShape) -> Any:
    """The shape after steps from rest, of an arm that bears something."""
    rest = lengths()
    none = torch.zeros_like(rest)
    state = of.initial_state(0.9 * q() + torch.stack((none, none, rest), dim=-1).flatten(-2))
    for _ in range(3):
        state = of(state, *seen())
    return (*state, of.configuration(state))


def fitted(of: ArcFit) -> Any:
    share = torch.linspace(0.25, 1.0, 4, dtype=torch.float64, **WHERE)
    return of(0.9 * q(), 1.1 * lengths(), backbone().points(q(), lengths(), 5)[1:], share)


def begun(of: ShapeFeedback, *rows: int) -> FollowedShape:
    return of.initial_state(q(*rows), lengths().expand(*rows, 2).clone())


def along(of: ShapeFeedback) -> Any:
    state, q_bar = begun(of), 0.9 * q()
    for _ in range(2):
        state, q_bar = of(state, q_bar, 1.02 * lengths(), *seen())
    return q_bar, state.lengths, state.shape.load
