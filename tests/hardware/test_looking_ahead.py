"""Looking ahead in a loop: only where there is time, and Eq. (16) elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.control.ahead import AheadStatus
from apcc_torch.experiments.realtime_run import run
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.log_replay import replay
from apcc_torch.hardware.looking_ahead import LAST, RESERVE, LookingAhead
from composed import composed_realtime

QUICK = (
    "experiment=setpoint", "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.5", "loop.hold=0.1",
    "compile=off", "view=false", "figures=false", "experiment.duration=0.3", "lookahead=mppi", "lookahead.samples=6",
    "lookahead.steps=3",
)  # fmt: skip


class Looks:
    """A controller whose looks take as long as they are told."""

    def __init__(self, clock: list[float], takes: list[float]) -> None:
        self.clock, self.takes = clock, takes

    def look_ahead(self, state: Any, target: Any, run: Any) -> Any:
        self.clock[0] += self.takes.pop(0)
        return state


class State:
    ahead = "looked"


def looking(takes: list[float]) -> tuple[LookingAhead, list[float], Callable[[], float]]:
    clock = [0.0]
    made: Any = Looks(clock, takes)
    return LookingAhead(made), clock, lambda: clock[0]


def test_a_look_begins_only_where_the_longest_one_would_end_in_time() -> None:
    look, clock, now = looking([3e-3, 2e-3])
    state: Any = State()
    assert look(state, state, now, 0.01) == "looked" and look(state, state, now, 0.01) == "looked"
    clock[0] = 0.01
    assert look(state, state, now, 0.01 + 0.9 * RESERVE * 3e-3) is None
    assert list(look.took) == [2e-3]  # the oldest is forgotten


def test_a_hold_up_is_forgotten() -> None:
    look, clock, now = looking([*[1e-3] * (LAST - 1), 1.0, 1e-3])
    state: Any = State()
    for _ in range(LAST):
        look(state, state, now, 100.0)
    turns = 0
    while look(state, state, now, clock[0] + 8e-3) is None:
        turns += 1
    assert turns == LAST


def test_a_run_looks_ahead_says_so_and_replays(tmp_path: Path) -> None:
    config = composed_realtime(*QUICK)
    torch.manual_seed(0)
    run(config, tmp_path)
    record = read_log(tmp_path / "log.mcap")
    rows = record.topic("/controller")
    assert int(rows["ahead"][0]) == AheadStatus.NONE and (rows["ahead"][1:] != AheadStatus.NONE).all()
    assert (rows["ahead"] == AheadStatus.FOLLOWED).any()
    again = replay(record, RealtimeBuilder(config).control())
    assert again.difference == 0.0
    without = replay(record, RealtimeBuilder(config.changed(lookahead=None)).control())
    assert without.difference > 1e-4 and np.isfinite(without.difference)
