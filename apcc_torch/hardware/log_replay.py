"""A log through the controller once more: the same measurements and targets must give the same commands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from apcc_torch.control.ahead import AheadStatus
from apcc_torch.errors import DataError
from apcc_torch.hardware.control import Control, Goal, Start
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.log_format import layouts
from apcc_torch.hardware.log_reader import RobotLog
from apcc_torch.hardware.sensing import GatedFrame


class Replayed(NamedTuple):
    """Wanted length changes at each control step.

    time: (T,) s. logged, replayed: (T, n_a) m.
    """

    time: Array
    logged: Array
    replayed: Array

    @property
    def difference(self) -> float:
        """Largest difference, m; NaN if any number is."""
        return float(np.abs(self.logged - self.replayed).max())


def replay(log: RobotLog, control: Control) -> Replayed:
    """Gives the controller what it was given, step by step.

    Args:
        log: Of a run.
        control: Built from the log's own settings, or from others to see what they would have done.

    Raises:
        DataError: The log holds no control step, lacks what one was given, or is of another arm.
    """
    n, n_b = control.controller.backbone.n, control.pi_hat.shape[-1]
    looks = control.looking is not None
    wanted = layouts(n, n_b, control.n_bodies, control.n_tendons, ahead=looks)
    first = log.rows(wanted.start, "q", "pi_hat", "first")[0]
    control.restart(Start(first["q"].copy(), first["pi_hat"].copy(), float(first["first"])))
    steps = log.rows(wanted.controller, "tick", "time", "y", *(["ahead"] if looks else []))
    targets = {int(row["tick"]): row for row in log.rows(wanted.target, "tick", "x_d", "xdot_d")}
    measured = log.rows(wanted.measurement, *(field.name for field in wanted.measurement.fields))
    frames = {int(row["tick"]): row for row in measured if row["usable"]}
    lengths = {int(row["tick"]): row["y"].copy() for row in log.rows(wanted.tendons, "tick", "y")}
    replayed = []
    with torch.inference_mode():
        for step in steps:
            tick = int(step["tick"])
            if tick not in frames or tick not in targets or tick not in lengths:
                raise DataError(f"the log lacks what the control step of turn {tick} was given")
            frame, target = _frame(frames[tick]), targets[tick]
            goal = Goal(target["x_d"], target["xdot_d"])
            if looks and step["ahead"] != AheadStatus.NONE:
                control.look_ahead(lambda: 0.0, np.inf)  # there was time
            replayed.append(control.decide(frame, lengths[tick], float(step["time"]), goal).y)
    count = len(replayed)
    return Replayed(steps["time"][:count], steps["y"][:count], np.array(replayed))


def _frame(row: np.void) -> GatedFrame:
    return GatedFrame(
        float(row["time"]),
        int(row["sequence"]),
        float(row["age"]),
        row["poses"].reshape(-1, 4, 4).copy(),
        row["position_ok"].astype(np.bool_),
        row["orientation_ok"].astype(np.bool_),
        row["position_reason"].copy(),
        row["orientation_reason"].copy(),
        bool(row["usable"]),
    )
