"""The figures and the film of one run of one controller, in simulation and on an arm alike."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from apcc_torch.report import dynamic
from apcc_torch.report.animation import save_animation
from apcc_torch.report.backbone_drawing import Snapshots, spread_indices, stroboscopic_figure
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.style import Draw, attempt, save_figures

MOMENTS = 6
"""Shapes in a stroboscopic figure."""


def in_sections(true_lengths: Tensor, n_sections: int) -> Tensor | None:
    """(n_sections,) rest lengths of a true arm of more sections, m; None where its sections do not end as the model's.

    Args:
        true_lengths: (n,) m; of an arm that differs by row there is none.
        n_sections: Of the model.
    """
    if true_lengths.dim() != 1 or true_lengths.shape[-1] % n_sections:
        return None
    return true_lengths.unflatten(-1, (n_sections, -1)).sum(-1)


def at_moments(shots: Snapshots) -> Snapshots:
    """Some of a run's moments, evenly spread."""
    at = spread_indices(shots.time, float(shots.time[0]), float(shots.time[-1]), MOMENTS)
    target = shots.target
    kept = target if target is None or target.dim() == 1 else target[at]
    time, true, model, on_true, on_model = (field[at] for field in shots[:5])
    return Snapshots(time, true, model, on_true, on_model, kept)


def run_figures(
    name: str, curves: RunCurves, shots: Snapshots | None, true: Tensor | None = None, title: str = ""
) -> dict[str, Draw]:
    """File name -> what draws it.

    Args:
        name: Of the controller, in the legends.
        curves: Of the run.
        shots: Every moment of one of its rows; None where the arm's shape is not known.
        true: (n_b,) rest lengths of the true arm, m, where they are known.
        title: Of the run.
    """
    runs = {name: curves}
    drawings: dict[str, Draw] = {
        "psi.png": lambda: dynamic.psi_figure(runs, title),
        "parameters.png": lambda: dynamic.parameter_figure(runs, f"{title}: rest lengths" if title else "", true),
        "sensors.png": lambda: dynamic.sensor_figure(runs, title),
        "end_effector.png": lambda: dynamic.end_effector_figure(runs, title=title),
        "mapping_error.png": lambda: dynamic.mapping_error_figure(runs, title),
    }
    if shots is not None:
        drawings["shape_error.png"] = lambda: dynamic.shape_error_figure(runs, title)
        drawings["stroboscopic.png"] = lambda: stroboscopic_figure({name: at_moments(shots)}, title=title)
    return drawings


def draw_run(
    folder: Path, drawings: dict[str, Draw], curves: RunCurves, shots: Snapshots | None, warning: str | None
) -> None:
    """Writes figures and, where the arm's shape is known, a film.

    Args:
        folder: Where to.
        drawings: As `run_figures`.
        curves, shots: As there; the film is of the last row.
        warning: Stands below each: that the run diverged.
    """
    save_figures(drawings, folder, warning=warning)
    if shots is None:
        return
    errors = {"shape error (mm)": 1e3 * curves.shape_error[:, -1], "end-effector error (mm)": 1e3 * curves.e[:, -1]}
    with attempt("the film"):
        save_animation(folder / "animation", shots, errors, warning=warning)
