"""Many periods of a loop in a row, with a log; for gradients over long times, with few of its states kept.

A gradient needs what every period computed. Checkpointed, only each segment's first state and its rows of the log are
kept, neither tensors nor torch's record of operations, and a segment is computed again when the gradient comes back to
it. The least memory is that of segments which need as much as all the states together; the time is one more run's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isqrt
from typing import Any, TypeVar

import torch
from torch import Tensor

from apcc_torch.simulation.log_rows import Rows
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.segment import Forgotten

S = TypeVar("S")
LIGHTER = 4
"""A segment has the root of the number of periods over this: a period's operations take some twenty times its state."""
Period = Callable[..., tuple[S, Sequence[Tensor]]]
"""(state, *arguments) -> the state one period later, and a row of the log."""


def rollout(
    period: Period[S],
    state: S,
    arguments: Callable[[int], tuple[Any, ...]],
    steps: int,
    checkpointed: bool = False,
    progress: Progress = quiet,
) -> tuple[S, list[Tensor]]:
    """Runs a loop.

    Args:
        period: One period; without chance of its own, so that it computes the same again.
        state: A tree of tensors.
        arguments: Number of a period -> what it is given besides the state. Called once a period, in order, so chance
            may be drawn here.
        steps: How many periods.
        checkpointed: Whether segments of some periods are computed again for a gradient, which then cannot be
            differentiated again; see `Forgotten`. Without gradients it changes nothing.
        progress: Wraps the step counter, for a progress bar.

    Returns:
        The last state, and the fields of the log, (steps, ...) each.
    """
    log = Rows(steps)
    counter = iter(progress(range(steps)))
    forgets = checkpointed and torch.is_grad_enabled()
    length = max(isqrt(steps) // LIGHTER, 1) if forgets else 1

    def segment(now: S, given: list[tuple[Any, ...]]) -> tuple[S, tuple[tuple[Tensor, ...], ...]]:
        rows = []
        for one in given:
            now, row = period(now, *one)
            rows.append(tuple(row))
        return now, tuple(rows)

    run = Forgotten(segment) if forgets else segment
    while given := [arguments(k) for _, k in zip(range(length), counter, strict=False)]:
        state, rows = run(state, given)
        for row in rows:
            log.add(row)
    return state, log.stacked()
