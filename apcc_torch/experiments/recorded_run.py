"""Finished runs as they are viewed: the folder of a simulation, or the log of a run on an arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import DataError
from apcc_torch.experiments import dynamic, kinematic
from apcc_torch.experiments.realtime_run import LOG, settings_of
from apcc_torch.experiments.redrawing import load_run
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.outline import Outline
from apcc_torch.viewing.recorded import Recorded

TRAJECTORY = "trajectory.npz"


def recorded(path: Path) -> Recorded:
    """The run that a folder or a log holds.

    Args:
        path: A run's folder, its trajectory.npz, or a log.mcap.

    Raises:
        DataError: There is none, or it cannot be read.
        ConfigError: The settings of a log have no meaning.
    """
    folder = path.parent if path.name == TRAJECTORY else path
    try:
        if path.suffix == ".mcap":
            return of_log(read_log(path), path.parent.name or path.stem)
        if (folder / TRAJECTORY).is_file():
            return of_folder(folder)
        if (folder / LOG).is_file():
            return of_log(read_log(folder / LOG), folder.name)
    except KeyError as error:
        raise DataError(f"{path} has no {error}") from error
    raise DataError(f"{path} holds no {TRAJECTORY} and no {LOG}: name the folder of one run")


def of_folder(folder: Path) -> Recorded:
    """A simulation's folder.

    Raises:
        DataError: It cannot be read, or holds no arm, as that of a replay.
    """
    config, arrays = load_run(folder)
    kind = config.experiment.kind
    if kind not in ("dynamic", "kinematic"):
        raise DataError(f"{folder} is of experiment.kind={kind}, which has no true arm to show")
    return (_dynamic if kind == "dynamic" else _kinematic)(folder.resolve().name, config, arrays)


def _dynamic(name: str, config: SimulateSettings, arrays: dict[str, Tensor]) -> Recorded:
    log, arms = dynamic.loaded(config, arrays)
    build = Builder(config)
    true = build.true_arm
    rows = [f"{1e3 * mass:.0f} g at the tip" for mass in build.payloads().tolist()]
    if config.experiment.setpoints:
        points = range(len(build.setpoints()))
        rows = [f"set-point {i}, {row}" for i in points for row in rows]
    return Recorded(
        name=name,
        size=DrawnSize.of(true),
        time=log.time,
        x_d=log.x_d,
        error=(log.x_d - log.x).norm(dim=-1),
        arm=Outline(arms.true, true.n_sections, build.placed(true.routing())),
        q=log.q_true,
        lengths=arms.true_lengths,
        model=Outline(arms.model, arms.model.n_sections),
        q_bar=log.q_bar,
        pi_hat=log.pi_hat,
        abscissae=build.true_sensors_at(),
        noise=float(config.sensors.position_noise),
        tension=-log.u,
        rows=tuple(rows),
    )


def _kinematic(name: str, config: SimulateSettings, arrays: dict[str, Tensor]) -> Recorded:
    log, pi, controller, _ = kinematic.loaded(config, arrays)
    build = Builder(config)
    count = log.q_true.shape[1]
    starts = [", ".join(f"{1e3 * v:.0f}" for v in lengths) for lengths in log.pi_hat[0].tolist()]
    return Recorded(
        name=name,
        size=DrawnSize.of(build.arm),
        time=log.time,
        x_d=log.x_d.expand_as(log.x),
        error=(log.x_d - log.x).norm(dim=-1),
        arm=Outline(controller.backbone, build.n_sections, build.routing()),
        q=log.q_true,
        lengths=pi if pi.dim() == 1 else pi.expand(*log.q_true.shape[:2], -1),
        model=Outline(controller.backbone, build.n_sections),
        q_bar=log.q_bar,
        pi_hat=log.pi_hat,
        abscissae=controller.feedback.abscissae,
        noise=float(config.sensors.position_noise),
        rows=tuple(f"first believed {start} mm" for start in starts) if count > 1 else ("",),
    )


def of_log(log: RobotLog, name: str) -> Recorded:
    """A log: the controller's model is drawn as the arm, and the sensors where they were measured.

    Raises:
        DataError: It has no step of the controller, or lacks what one was given.
        ConfigError: Its settings have no meaning.
    """
    realtime = RealtimeBuilder(settings_of(log))
    build, layouts = realtime.model, realtime.layouts()
    steps = log.rows(layouts.controller, "tick", "time", "q_bar", "pi_hat", "e")
    if not len(steps):
        raise DataError("the log holds no step of the controller")
    ticks = steps["tick"]
    targets = _at(ticks, log.rows(layouts.target, "tick", "x_d"))["x_d"]
    frames = _at(ticks, log.rows(layouts.measurement, "tick", "time", "poses", "position_ok", "orientation_ok"))
    seen = (frames["position_ok"] & frames["orientation_ok"]).astype(bool)
    poses = np.where(seen[..., None, None], frames["poses"].reshape(len(steps), -1, 4, 4), np.nan)
    tendons = _at(ticks, log.rows(layouts.tendons, "tick", "effort"))["effort"]
    backbone = build.backbone()
    # q_bar belongs to the rest lengths before the step, and the log has those after it.
    first = log.rows(layouts.start, "pi_hat")["pi_hat"][:1]
    pi_hat = _row(np.concatenate((first, steps["pi_hat"][:-1])))
    return Recorded(
        name=name,
        size=DrawnSize.of(build.arm),
        time=torch.from_numpy(steps["time"].copy()),
        x_d=_row(targets),
        error=_row(steps["e"]).norm(dim=-1),
        arm=Outline(backbone, build.n_sections, build.routing()),
        q=_row(steps["q_bar"]),
        lengths=pi_hat,
        model=None,
        q_bar=_row(steps["q_bar"]),
        pi_hat=pi_hat,
        poses=_row(poses),
        tension=_row(tendons),
    )


def _at(ticks: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The messages of those turns; the last one before, where a turn has none."""
    if not len(rows):
        raise DataError("the log lacks what its steps of the controller were given")
    return rows[(np.searchsorted(rows["tick"], ticks, side="right") - 1).clip(min=0)]


def _row(values: np.ndarray) -> Tensor:
    """(T, 1, ...) of one row's (T, ...)."""
    return torch.from_numpy(np.array(values, dtype=np.float64)).unsqueeze(1)
