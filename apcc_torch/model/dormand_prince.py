"""An adaptive reference for time steps: Dormand and Prince's pair of orders 5 and 4, every row with its own steps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.integrators import Field
from apcc_torch.modes import holds

# Dormand and Prince's tableau: nodes, stage rows, and the difference between the 5th and 4th order weights.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


class Trajectory(NamedTuple):
    """states (T, ..., m), time first; diverged_at (...) int64, the index of the first time a row did not reach, or -1;
    steps (...) int64 accepted steps of each row."""

    states: Tensor
    diverged_at: Tensor
    steps: Tensor


def dormand_prince_step(field: Field, t: Tensor, x: Tensor, h: Tensor, first: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One embedded step: the 5th order result, its error estimate, and field at the result (the next `first`).

    Args:
        field: (t, x) -> dx/dt.
        t: (...) time of each row, s.
        x: (..., m).
        h: (...) step of each row, s.
        first: (..., m) field(t, x).
    """
    wide = h.unsqueeze(-1)
    slopes = [first]
    result = x
    for node, row in zip(_NODES[1:], _STAGES[1:], strict=True):
        slope = sum((a * k for a, k in zip(row, slopes, strict=True) if a != 0.0), torch.zeros_like(x))
        result = x + wide * slope
        slopes.append(field(t + node * h, result))
    error = wide * sum((e * k for e, k in zip(_ERROR, slopes, strict=True) if e != 0.0), torch.zeros_like(x))
    return result, error, slopes[-1]


def reference(
    field: Field,
    x: Tensor,
    times: Tensor,
    rtol: float = 1e-9,
    atol: float = 1e-11,
    first_step: float = 1e-4,
    max_steps: int = 1_000_000,
    bound: float = 1e6,
) -> Trajectory:
    """Integrates dx/dt = field(t, x) with error control per row (Dormand-Prince 5(4)); slow and accurate.

    How many steps there are is a matter of values: it cannot be compiled, exported or vectorised.

    Every row has its own time and step, and steps onto each of `times`. A row whose step size collapses or that leaves
    `bound` is frozen at its last good state.

    Args:
        field: (t (...), x (..., m)) -> (..., m).
        x: (..., m) state at times[0].
        times: (T,) increasing, s.
        rtol: Relative tolerance per step.
        atol: Absolute tolerance per step, in the state's units.
        first_step: First step tried, s.
        max_steps: Attempted steps in total before the rows still running are given up.
        bound: Largest magnitude of any entry.

    Raises:
        ValueRangeError: `times` does not increase.
    """
    if not holds(times.diff() > 0):
        raise ValueRangeError("times must increase")
    rows = x.shape[:-1]
    t = times[0].expand(rows)
    h = torch.full(rows, first_step, dtype=x.dtype, device=x.device)
    diverged_at = torch.full(rows, -1, dtype=torch.int64, device=x.device)
    steps = torch.zeros(rows, dtype=torch.int64, device=x.device)
    slope = field(t, x)
    states = [x]
    smallest = 1e-14 * float(times[-1] - times[0])
    attempts = 0
    for index in range(1, len(times)):
        goal = times[index]
        while bool((running := (t < goal) & (diverged_at < 0)).any()):
            attempts += 1
            last = t + h >= goal
            trial = torch.where(last, goal - t, h)
            proposed, error, after = dormand_prince_step(field, t, x, trial, slope)
            scale = atol + rtol * torch.maximum(x.abs(), proposed.abs())
            size = torch.sqrt(((error / scale) ** 2).mean(-1))
            finite = (proposed.abs() <= bound).all(-1) & torch.isfinite(after).all(-1)
            accept = running & finite & (size <= 1.0)
            factor = (0.9 * size.clamp(min=1e-10) ** -0.2).clamp(0.2, 5.0)
            # A step that is not finite says nothing about the error: shrink hard.
            changed = torch.where(finite, trial * factor, 0.1 * trial)
            # A step cut short by a goal must not make the next ones short.
            changed = torch.where(accept & last, torch.maximum(changed, h), changed)
            wide = accept.unsqueeze(-1)
            x, slope = torch.where(wide, proposed, x), torch.where(wide, after, slope)
            t = torch.where(accept, torch.where(last, goal, t + trial), t)
            steps = steps + accept
            h = torch.where(running, changed, h)
            lost = running & ~accept & ((h < smallest) | (attempts >= max_steps))
            diverged_at = torch.where(lost, index, diverged_at)
        states.append(x)
    return Trajectory(torch.stack(states), diverged_at, steps)
