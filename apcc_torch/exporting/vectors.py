"""Reference steps: what the Python controller does with an arm that moves, for a library's own test."""

from __future__ import annotations

from collections.abc import Sequence as Listed
from typing import Any, NamedTuple

import torch

from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.exporting.functions import Controller, Function, blank, kinematic
from apcc_torch.model.abscissae import decouple

PERIOD = 0.01
"""s between two steps."""
BEND, STRETCH = 0.4, 0.01
"""How far the arm moves, rad and m."""
AIM = 0.05
"""How far the target is away from where the arm moves, m."""


class Sequence(NamedTuple):
    """Steps one after the other, from the beginning of `control_functions`.

    measurements, targets: What goes in. answers: `Answer`s. uncertainty: Of the last step; None without a function
    for it.
    """

    measurements: list[Measurement]
    targets: list[Target]
    answers: list[Any]
    uncertainty: Any


def sequence(controller: Controller, functions: Listed[Function], count: int) -> Sequence:
    """Steps with an arm that swings. In the last but one no sensor is seen, in the one before one orientation is not.

    Args:
        controller: With a routing.
        functions: Its functions.
        count: How many, at least 3.
    """
    of = {function.name: function for function in functions}
    (beginning,) = of["start"].example
    state = of["start"].module(beginning)
    inner, pi_hat = kinematic(controller), beginning.pi_hat
    model, places = inner.backbone, decouple(inner.feedback.abscissae.to(pi_hat), pi_hat)
    rng = torch.Generator().manual_seed(0)
    phase = 6.28 * torch.rand(model.n, generator=rng, dtype=torch.float64).to(pi_hat)
    reach = model.coordinates.per_unit(BEND, STRETCH, model.n, pi_hat)
    blank_measurement, blank_target = blank(controller, pi_hat)[1:]
    every = torch.ones(inner.feedback.abscissae.shape[-1], dtype=torch.bool)
    measurements, targets, answers, uncertainty = [], [], [], None
    for k in range(count):
        q = reach * torch.sin(phase + 0.1 * k)
        T = model.pose(q, pi_hat, *places)
        measurement = blank_measurement._replace(T=T, time=blank_measurement.time + PERIOD * (k + 1))
        if measurement.tendons is not None:
            measurement = measurement._replace(tendons=inner.tendons(q, pi_hat))
        if k == count - 2:
            measurement = measurement._replace(mask=~every)
        if k == count - 3:
            measurement = measurement._replace(angular_mask=every.clone().index_fill(0, torch.tensor([0]), False))
        target = blank_target._replace(x_d=T[-1, :3, 3] + AIM)
        before = state
        state, answer = of["step"].module(state, measurement, target)
        measurements.append(measurement)
        targets.append(target)
        answers.append(answer)
    if "covariance" in of:
        uncertainty = of["covariance"].module(before, state, measurements[-1])
    return Sequence(measurements, targets, answers, uncertainty)
