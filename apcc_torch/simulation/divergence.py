"""When a run has run away: what neither an arm nor a model of it can be, relative to the arm's own length."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.model.coordinates import CONSTANT_CURVATURE, Coordinates
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.simulation.dynamic import DynamicLog
from apcc_torch.simulation.kinematic import KinematicLog

SHORTEST = 1.0
"""Shortest end of a run, s, that tells whether something lasts."""
NEARER = 0.9
"""A tip that comes below this share of its least error before is on its way."""
ROUNDING = 1e-6
"""A rest length this share of it away from a bound is at it."""
LISTED = 5
"""Most rows that a sentence names."""


class Cause(IntFlag):
    """What a row diverged by; a row's causes are added.

    Example:
        >>> Cause(12)
        <Cause.SHAPE|ELONGATION: 12>
    """

    NOT_FINITE = 1
    LEFT_BOUNDS = 2
    """A coordinate or its rate left the plant's bound: the row stays where it was."""
    SHAPE = 4
    """The model is farther from the arm than its length allows."""
    ELONGATION = 8
    """A section, of the arm or of its model, is stretched or turned inside out."""
    LENGTHS = 16
    """A rest length stays at its bound while the model does not fit."""
    TIP = 32
    """The tip is farther off than an arm can be, or stays away from its target without coming nearer."""


SAID = {
    Cause.NOT_FINITE: "not finite",
    Cause.LEFT_BOUNDS: "out of the plant's bound",
    Cause.SHAPE: "shape error",
    Cause.ELONGATION: "elongation",
    Cause.LENGTHS: "rest lengths at their bounds",
    Cause.TIP: "tip error",
}


@dataclass(frozen=True, kw_only=True)
class DivergenceSettings(Settings):
    """Settings of `Divergence`."""

    shape: float = setting(0.25, "", OURS, "largest shape error over the arm's length", above=0)
    elongation: float = setting(
        1.5, "", OURS, "largest change of a section's length over its rest length; a moment below -1 heals", above=0
    )
    misfit: float = setting(
        0.05, "", OURS, "shape error over the arm's length that counts where a rest length rests at its bound", above=0
    )
    tip: float = setting(0.1, "", OURS, "tip error over the arm's length that counts as away from the target", above=0)
    dwell: float = setting(5.0, "s", OURS, "the end of a run, at most half, through which either has to last", above=0)


def stretch(q: Tensor, lengths: Tensor, coordinates: Coordinates = CONSTANT_CURVATURE) -> Tensor:
    """Elongations (..., n_b) of configurations (..., n) over rest lengths (..., n_b), m.

    Example:
        >>> stretch(torch.tensor([0.0, 0.0, -0.2]), torch.tensor([0.1]))
        tensor([-2.])
    """
    return q[..., coordinates.elongations] / lengths


def at_bound(pi_hat: Tensor, bounds: LengthBounds | None) -> Tensor:
    """Whether (...) any of the rest lengths (..., n_b) is at a bound, or pushed beyond it by the reach."""
    at = torch.zeros_like(pi_hat, dtype=torch.bool)
    if bounds is not None and bounds.least is not None:
        at = at | (pi_hat <= (1.0 + ROUNDING) * bounds.least.to(pi_hat))
    if bounds is not None and bounds.largest is not None:
        at = at | (pi_hat >= (1.0 - ROUNDING) * bounds.largest.to(pi_hat))
    return at.any(-1)


class Divergence(Part):
    """Judges arm and model by what the arm's length allows: in simulations, environments, replays and on an arm alike.

    Args:
        *settings, **changes: See `DivergenceSettings`.

    Example:
        >>> divergence, unstretched = Divergence(), torch.zeros(2, 3)
        >>> divergence.now(torch.tensor(0.6), unstretched, gap=torch.tensor([0.02, 0.5]))
        tensor([0, 4])
    """

    settings_type = DivergenceSettings
    shape: float
    elongation: float
    misfit: float
    tip: float
    dwell: float

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(DivergenceSettings, settings, changes))

    def now(self, length: Tensor, stretches: Tensor, gap: Tensor | None = None, e: Tensor | None = None) -> Tensor:
        """`Cause`s (...) int64 that a moment shows by itself, 0 for none.

        Args:
            length: (...) of the arm, m.
            stretches: (..., m) of the sections of arm and model, from `stretch`.
            gap: (...) m, mean distance of model and arm: of their backbones, or at the sensors; None: not known.
            e: (...) m, tip error; None: there is no target.
        """
        finite = torch.isfinite(stretches).all(-1)
        causes = _where(Cause.ELONGATION, (stretches.abs() > self.elongation).any(-1))
        if gap is not None:
            finite = finite & torch.isfinite(gap)
            causes = causes | _where(Cause.SHAPE, gap > self.shape * length)
        if e is not None:
            finite = finite & torch.isfinite(e)
            # An arm and a target within its reach are both within its length of the base.
            causes = causes | _where(Cause.TIP, e > 2.0 * length)
        return causes | _where(Cause.NOT_FINITE, ~finite)

    def forward(
        self,
        time: Tensor,
        length: Tensor,
        stretches: Tensor,
        gap: Tensor | None = None,
        e: Tensor | None = None,
        at_bound: Tensor | None = None,
        left_at: Tensor | None = None,
    ) -> Tensor:
        """`Cause`s (T, R) int64 that a run's rows have shown until each instant; the last ones are the verdict.

        Args:
            time: (T,) s.
            length: (R,) or () m, as `now`; so are the next three, time first: (T, R, m) and (T, R).
            stretches, gap, e: See `now`.
            at_bound: (T, R) bool, whether a rest length is at its bound, from `at_bound`; None: nowhere.
            left_at: (R,) s, when a row left the plant's bound, infinite where it did not; None: no row did.
        """
        causes = self.now(length, stretches, gap, e)
        if left_at is not None:
            causes = causes | _where(Cause.LEFT_BOUNDS, time.unsqueeze(-1) >= left_at)
        width = torch.clamp(0.5 * (time[-1] - time[0]), max=self.dwell)
        end = ((time >= time[-1] - width) & (width >= SHORTEST)).unsqueeze(-1)
        if at_bound is not None and gap is not None:
            stuck = (at_bound & (gap > self.misfit * length)) | ~end
            causes = causes | _where(Cause.LENGTHS, end & stuck.all(0))
        if e is not None:
            before, after = (torch.where(end == late, e, torch.inf).amin(0) for late in (False, True))
            away = (after > self.tip * length) & (after >= NEARER * before)
            causes = causes | _where(Cause.TIP, end & away)
        return sum(_where(each, (causes & each).cummax(0).values > 0) for each in Cause)  # type: ignore[return-value]

    def of_arm(
        self,
        log: KinematicLog | DynamicLog,
        gap: Tensor,
        lengths: Tensor,
        true: KinematicModel,
        model: KinematicModel,
        bounds: LengthBounds | None,
        left_at: Tensor | None = None,
    ) -> Tensor:
        """`forward` (T, R) of a simulation's rows, whose true arm is known.

        Args:
            log: What the rows did.
            gap, left_at: See `forward`.
            lengths: (..., n_t) m, of the true arm's sections.
            true, model: The backbones.
            bounds: Of pi_hat; None where it does not adapt.
        """
        arms = (stretch(log.q_true, lengths, true.coordinates), stretch(log.q_bar, log.pi_hat, model.coordinates))
        e = (log.x_d - log.x).norm(dim=-1)
        bound = at_bound(log.pi_hat, bounds)
        causes: Tensor = self(log.time, lengths.sum(-1), torch.cat(arms, dim=-1), gap, e, bound, left_at)
        return causes

    def of_model(
        self,
        controller: APCCController,
        length: Tensor,
        time: Tensor,
        q_bar: Tensor,
        pi_hat: Tensor,
        linear: Tensor,
        e: Tensor | None = None,
    ) -> Tensor:
        """`forward` (T, 1) of one arm whose true shape is not known: the model is judged at the sensors.

        Args:
            controller: Whose model it is.
            length: () of the arm, m.
            time: (T,) s.
            q_bar, pi_hat: (T, n) and (T, n_b) m.
            linear: (T, k) m, distances of model and sensors; NaN where a sensor did not count.
            e: (T,) m, tip error; None where the arm was not driven to a target.
        """
        stretches = stretch(q_bar, pi_hat, controller.backbone.coordinates)
        gap = linear.nanmean(-1).nan_to_num(0.0)
        bound = at_bound(pi_hat, controller.bounds if controller.adaptive else None)
        rows = [None if value is None else value.unsqueeze(1) for value in (stretches, gap, e, bound)]
        causes: Tensor = self(time, length, *rows)
        return causes


def _where(cause: Cause, condition: Tensor) -> Tensor:
    return condition.to(torch.int64) * int(cause)


def sentence(time: Tensor, causes: Tensor) -> str | None:
    """What a run's end says of its causes (T, R) at times (T,) s; None where no row diverged.

    Example:
        >>> sentence(torch.tensor([0.0, 0.5]), torch.tensor([[0, 0], [0, 12]]))
        '1 of 2 rows diverged: row 1 from 0.5 s (shape error, elongation)'
    """
    rows = causes[-1].nonzero().flatten().tolist()
    if not rows:
        return None
    told = []
    for row in rows[:LISTED]:
        since = float(time[int((causes[:, row] > 0).int().argmax())])
        told.append(f"row {row} from {since:.3g} s ({', '.join(SAID[each] for each in Cause(int(causes[-1, row])))})")
    more = [f"and {len(rows) - LISTED} more"] if len(rows) > LISTED else []
    return f"{len(rows)} of {causes.shape[-1]} rows diverged: {', '.join([*told, *more])}"
