"""Experiment II of the paper: the actuation mismatch of Eq. (53), and what else the logs of its runs tell.

Runs are named LAYOUT_RUN_CONTROLLER, such as coupled_1_adaptive: the tendon layout that the model believes in, the run
of the paper, the controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from apcc_torch.composition.build import Builder
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.experiments.realtime_run import LOG, settings_of
from apcc_torch.files import write_atomically, write_json
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.paper.measured_curve import measured_curve
from apcc_torch.report.dynamic import RunCurves, mapping_error_figure, psi_figure, sensor_figure
from apcc_torch.report.overlay import Overlay, error_figure, overlay_figure
from apcc_torch.report.style import Draw
from apcc_torch.report.text_table import aligned
from apcc_torch.simulation.metrics import mapping_error

FIGURES = {
    "1": {"overlay": 27, "error": 28, "psi": 29, "mapping": 30},
    "2": {"overlay": 31, "error": 32, "psi": 33, "mapping": 34, "sensors": 35},
    "3": {"error": 36, "psi": 37, "mapping": 38, "sensors": 39},
}
"""Run of the paper -> drawing -> the figure's number."""


class Run(NamedTuple):
    """A run's curves, its last moment, and the error at which it counts as arrived, m."""

    curves: RunCurves
    overlay: Overlay
    arrival: float


def curves(record: RobotLog) -> Run:
    """What a log tells of its run. The shape error is not known on an arm: it is NaN.

    Raises:
        DataError: The log lacks settings, measurements or control steps.
    """
    config = settings_of(record)
    build = Builder(config)
    steps, frames = record.topic("/controller"), record.topic("/measurement")
    poses = {int(row["tick"]): row["poses"] for row in frames}
    lacking = [int(tick) for tick in steps["tick"] if int(tick) not in poses]
    if lacking:
        raise DataError(f"the log lacks the measurement of turn {lacking[0]}, which a control step was given")
    T = torch.stack([torch.tensor(poses[int(tick)]).unflatten(-1, (-1, 4, 4)) for tick in steps["tick"]])
    time, e, q_bar, q_d, pi_hat, angular, linear = (
        torch.tensor(steps[name]) for name in ("time", "e", "q_bar", "q_d", "pi_hat", "angular_error", "linear_error")
    )
    controller = build.controller().double()
    backbone = controller.backbone
    distance = torch.linalg.vector_norm(e, dim=-1)
    length = build.rest_lengths().sum().double()
    diverged = build.divergence().of_model(controller, length, time, q_bar, pi_hat, linear, distance)
    records = RunCurves(
        time,
        torch.full_like(time, torch.nan).unsqueeze(-1),
        torch.linalg.vector_norm(q_bar[:, backbone.coordinates.elongations], dim=-1, keepdim=True),
        angular.unsqueeze(1),
        linear.unsqueeze(1),
        distance.unsqueeze(-1),
        pi_hat.unsqueeze(1),
        mapping_error(backbone, q_d, pi_hat, T[:, -1, :3, 3]).unsqueeze(-1),
        diverged,
    )
    curve = measured_curve(build.base_rotation(), T[-1])
    goal = torch.tensor(record.topic("/target")["x_d"][-1])
    last = Overlay(curve, T[-1, :, :3, 3], backbone.points(q_bar[-1], pi_hat[-1], 100), goal)
    return Run(records, last, config.guards.arrival_error or 1e-3)


def numbers(run: Run) -> dict[str, float]:
    """A run in numbers."""
    c = run.curves
    return {
        "duration_s": float(c.time[-1]),
        "arrived": float(c.e[-1, 0] < run.arrival),
        "end_effector_error_end_mm": 1e3 * float(c.e[-1, 0]),
        "psi_mean_cm": 1e2 * float(c.psi.mean()),
        "mapping_error_mean_cm": 1e2 * float(c.mapping_error.mean()),
        "mapping_error_end_cm": 1e2 * float(c.mapping_error[-1, 0]),
        "sensor_error_linear_mean_mm": 1e3 * float(c.linear.mean()),
        "sensor_error_angular_mean_rad": float(c.angular.mean()),
    }


def split(name: str) -> tuple[str, str, str]:
    """Layout, run and controller of a run's name.

    Raises:
        ConfigError: It is not made of the three.
    """
    parts = name.split("_", 2)
    if len(parts) != 3 or parts[1] not in FIGURES:
        raise ConfigError(f"runs of experiment II must be named LAYOUT_RUN_CONTROLLER, got {name!r}")
    return parts[0], parts[1], parts[2]


def study(folder: Path, runs: Sequence[str]) -> tuple[dict[str, float], dict[str, Draw]]:
    """The table of all runs (table.json, table.txt), and what draws figures 27 to 39 of each layout.

    Args:
        folder: Of the series.
        runs: Their names, a folder each.

    Returns:
        Every number of every run, flat; and file name -> what draws it.
    """
    records: dict[tuple[str, str], dict[str, Run]] = {}
    table: dict[str, dict[str, float]] = {}
    for name in runs:
        layout, run, controller = split(name)
        record = curves(read_log(folder / name / LOG))
        records.setdefault((layout, run), {})[controller] = record
        table[name] = numbers(record)
    write_json(folder / "table.json", table)
    write_atomically(folder / "table.txt", text(table))
    drawings = {
        f"{layout}/{file}": draw
        for (layout, run), members in records.items()
        for file, draw in _drawn(run, members).items()
    }
    return {f"{name}_{key}": value for name, row in table.items() for key, value in row.items()}, drawings


def _drawn(run: str, members: dict[str, Run]) -> dict[str, Draw]:
    """What draws the run's figures, by file name."""
    all_curves = {name: member.curves for name, member in members.items()}
    arrival = next(iter(members.values())).arrival
    drawings: dict[str, Draw] = {
        "error": lambda: error_figure(all_curves, arrival),
        "psi": lambda: psi_figure(all_curves),
        "mapping": lambda: mapping_error_figure(all_curves),
        "sensors": lambda: sensor_figure(all_curves),
        "overlay": lambda: overlay_figure({name: member.overlay for name, member in members.items()}),
    }
    return {f"fig_{number}.png": drawings[kind] for kind, number in FIGURES[run].items()}


def text(table: dict[str, dict[str, float]]) -> str:
    """The table as text, a line a run."""
    keys = list(next(iter(table.values())))
    lines = [["run", *keys], *([name, *(f"{row[key]:.4g}" for key in keys)] for name, row in table.items())]
    return aligned(lines) + "\n"
