"""Experiment I of the paper: what algorithm 2 infers of one motion in four ways, from the logs of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.errors import DataError
from apcc_torch.experiments.realtime_run import LOG, settings_of
from apcc_torch.files import write_atomically, write_json
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.paper.measured_curve import measured_curve
from apcc_torch.report.state_feedback import Estimate, Estimates, final_figure, four_panel_figure, norm_figure
from apcc_torch.report.style import Draw
from apcc_torch.report.text_table import aligned

MODES = ("pose", "position")
STROBOSCOPIC = {"run_4": "fig_23.png", "run_8": "fig_24.png"}
POINTS = 60
"""Points along a drawn model."""
MOMENTS = 6
"""Shapes in a stroboscopic panel."""


class Motion(NamedTuple):
    """The measurements of a run: time (T,) s, poses (T, k, 4, 4) m, masks (T, k)."""

    time: Tensor
    T: Tensor
    position_ok: Tensor
    orientation_ok: Tensor


def motion(folder: Path) -> tuple[RealtimeSettings, Motion]:
    """A run's settings and what its sensors saw.

    Raises:
        DataError: The log cannot be read, or has no usable measurement.
    """
    record = read_log(folder / LOG)
    rows = record.topic("/measurement")
    rows = rows[rows["usable"] == 1]
    if not len(rows):
        raise DataError(f"{folder / LOG} has no measurement that an estimate could be made from")
    poses = torch.tensor(rows["poses"]).unflatten(-1, (-1, 4, 4))
    masks = (torch.tensor(rows[name]).bool() for name in ("position_ok", "orientation_ok"))
    return settings_of(record), Motion(torch.tensor(rows["time"]), poses, *masks)


def estimate(config: RealtimeSettings, seen: Motion) -> Estimates:
    """Algorithm 2 over a run, decoupled and not, from poses and from positions, each from its own last result.

    Raises:
        DataError: The run has no estimate for the decoupled case.
    """
    if config.ramp.estimate is None:
        raise DataError("ramp.estimate must be given in each run of experiment I")
    cases = {"non-decoupled": config.arm.lengths, "decoupled": config.ramp.estimate}
    pi_hat = torch.tensor(list(cases.values()), dtype=torch.float64)
    outcome: Estimates = {}
    for mode in MODES:
        feedback = config.feedback.changed(mode=mode)
        build = Builder(config.changed(feedback=feedback, dtype="float64"))
        algorithm, backbone = build.controller().feedback, build.backbone()
        q = torch.zeros(len(cases), backbone.n, dtype=torch.float64)
        results = []
        with torch.inference_mode():
            for k in range(len(seen.time)):
                T, masks = seen.T[k], (seen.position_ok[k], seen.orientation_ok[k])
                results.append(algorithm(q, pi_hat, T.expand(len(cases), *T.shape), *masks))
                q = results[-1].q_bar
            states = torch.stack([result.q_bar for result in results])
            points = backbone.points(states, pi_hat, POINTS)
        angular = torch.stack([result.angular_error for result in results])
        linear = torch.stack([result.linear_error for result in results])
        for i, case in enumerate(cases):
            outcome[case, mode] = Estimate(seen.time, points[:, i], seen.T[..., :3, 3], angular[:, i], linear[:, i])
    return outcome


def study(folder: Path, runs: Sequence[str]) -> tuple[dict[str, float], dict[str, Draw]]:
    """The table of all runs (table.json, table.txt), and what draws figures 23 to 26.

    Args:
        folder: Of the series.
        runs: Their names, a folder each.

    Returns:
        Means over the runs, SI units in the names; and file name -> what draws it.
    """
    outcome: dict[str, Estimates] = {}
    table: dict[str, object] = {}
    last: dict[str, tuple[Tensor, Tensor]] = {}
    for name in runs:
        config, seen = motion(folder / name)
        outcome[name] = estimate(config, seen)
        last[name] = measured_curve(Builder(config).base_rotation(), seen.T[-1]), seen.T[-1, :, :3, 3]
        table[name] = {
            "goal_m": config.ramp.goal,
            "pi_m": config.arm.lengths,
            "pi_hat_m": config.ramp.estimate,
            **{f"{case}, {mode}": numbers(e) for (case, mode), e in outcome[name].items()},
        }
    write_json(folder / "table.json", table)
    write_atomically(folder / "table.txt", text(outcome))
    shown = [name for name in runs if name in STROBOSCOPIC]
    drawings: dict[str, Draw] = {
        STROBOSCOPIC[name]: partial(four_panel_figure, outcome[name], MOMENTS, name) for name in shown
    }
    drawings["fig_25.png"] = lambda: final_figure({name: last[name] for name in shown} or last)
    drawings["fig_26.png"] = lambda: norm_figure(list(outcome.values()))
    keys = next(iter(outcome.values())).keys()
    metrics: dict[str, float] = {}
    for case, mode in keys:
        for name, value in _mean([numbers(e[case, mode]) for e in outcome.values()]).items():
            metrics[f"{case.replace('-', '_')}_{mode}_{name}"] = value
    return metrics, drawings


def numbers(e: Estimate) -> dict[str, float]:
    """A run in numbers: over time, and at its end; means over the sensors."""
    return {
        "linear_mean_mm": 1e3 * float(e.linear.mean()),
        "linear_end_mm": 1e3 * float(e.linear[-1].mean()),
        "angular_mean_rad": float(e.angular.mean()),
        "angular_end_rad": float(e.angular[-1].mean()),
    }


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def text(outcome: dict[str, Estimates]) -> str:
    """The table as text: sensor errors at the end of each run, mm and rad."""
    keys = list(next(iter(outcome.values())))
    lines = [["run", *(f"{case}, {mode}" for case, mode in keys)]]
    for name, estimates in outcome.items():
        ends = [numbers(estimates[key]) for key in keys]
        lines.append([name, *(f"{n['linear_end_mm']:.2f} mm {n['angular_end_rad']:.4f} rad" for n in ends)])
    return aligned(lines) + "\n"
