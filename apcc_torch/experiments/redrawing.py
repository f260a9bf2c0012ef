"""Figures and films of a run from what it left in its folder, without running it again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from apcc_torch.classes import Trust
from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ApccError, DataError
from apcc_torch.experiments import dynamic, kinematic
from apcc_torch.reading import read
from apcc_torch.report.animation import save_animation
from apcc_torch.report.backbone_drawing import Snapshots
from apcc_torch.report.kinematic import select_row, snapshots
from apcc_torch.report.replay import ReplayCurves, replay_figure
from apcc_torch.report.style import save_figure
from apcc_torch.simulation.kinematic import KinematicLog
from apcc_torch.simulation.metrics import backbone_error

FILM_FRAMES = 120
INSTANTS = 600
"""Largest number of instants of a run that is drawn anew; more would not be seen."""


def load_run(folder: Path) -> tuple[SimulateSettings, dict[str, Tensor]]:
    """Settings and trajectory of a run's folder.

    Raises:
        DataError: config.yaml or trajectory.npz cannot be read, or the settings are not those of this version.
    """
    try:
        values = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
        config = read(values, SimulateSettings, trust=Trust.OWN)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, ApccError) as error:
        raise DataError(f"config.yaml does not hold this version's settings: {str(error).splitlines()[0]}") from error
    try:
        with np.load(folder / "trajectory.npz") as archive:
            return config, {name: torch.from_numpy(archive[name]) for name in archive.files}
    except (OSError, ValueError, EOFError) as error:  # also what a cut archive raises
        raise DataError(f"trajectory.npz cannot be read: {error}") from error


def draw_anew(folder: Path, into: Path, figured: bool, filmed: bool) -> None:
    """Draws a run into `into`/figures from its settings and its trajectory.

    Args:
        folder: The run's.
        into: Another folder.
        figured: Whether figures are wanted.
        filmed: Whether a film is.

    Raises:
        DataError: They cannot be read, or do not belong together.
    """
    config, arrays = load_run(folder)
    kind = {"kinematic": draw_kinematic, "dynamic": draw_dynamic, "replay": draw_replay}.get(config.experiment.kind)
    if kind is None:
        raise DataError(f"no figures are known for experiment.kind={config.experiment.kind}")
    try:
        with torch.inference_mode():
            kind(config, arrays, into / "figures", figured, filmed)
    except KeyError as error:
        raise DataError(f"trajectory.npz has no {error}") from error


def draw_kinematic(
    config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool
) -> None:
    """Figures 7, 8 and 9 of row 0, and its film."""
    outcome = kinematic.loaded(config, arrays)
    T = outcome.log.time.shape[0]
    kept = torch.arange(T - 1, -1, -max(1, -(-T // INSTANTS))).flip(0)
    outcome = outcome._replace(log=KinematicLog(*(field[kept] for field in outcome.log)))
    if figured:
        kinematic.draw(outcome, into)
    if filmed:
        shots, readouts = kinematic_film(outcome)
        save_animation(into / "animation", shots, readouts, max_frames=FILM_FRAMES)


def kinematic_film(outcome: kinematic.Outcome) -> tuple[Snapshots, dict[str, Tensor]]:
    """The moments of row 0, and the errors that run along."""
    pi, backbone = outcome.pi, outcome.controller.backbone
    log = select_row(outcome.log, 0)
    end = float(log.time[-1])
    shots = snapshots(log, pi, outcome.controller.feedback.abscissae, backbone, end, FILM_FRAMES)
    at = torch.isin(log.time, shots.time)
    error = 1e3 * backbone_error(backbone, log.q_true[at], pi, backbone, log.q_bar[at], log.pi_hat[at])
    readouts = {"shape error (mm)": error, "end-effector error (mm)": 1e3 * (log.x_d - log.x)[at].norm(dim=-1)}
    return shots._replace(target=log.x_d[at]), readouts


def draw_dynamic(config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool) -> None:
    """The paper's figures over all rows, and always the film of the last one: they are drawn together."""
    name = "adaptive" if config.controller.adaptive else "standard"
    dynamic.draw(dynamic.loaded(config, arrays), into, name)


def draw_replay(config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool) -> None:
    """What the estimator inferred from a recording; there is no true arm to film."""
    names = ("time", "q_bar", "angular_error", "linear_error", "position_reason", "orientation_reason")
    curves, coordinates = ReplayCurves(*(arrays[name] for name in names)), Builder(config).backbone().coordinates
    title = Path(config.data).name if config.data else ""
    figure = replay_figure(curves, title=title, coordinates=coordinates)
    save_figure(figure, into / "replay.png")
