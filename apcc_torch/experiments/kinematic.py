"""Section V-A: settings to a folder with metrics, the trajectory and figures 7, 8 and 9."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import elongation_cost
from apcc_torch.experiments.folder import RunFolder, progress_bar, warn
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.report.animation import save_animation
from apcc_torch.report.backbone_drawing import Snapshots
from apcc_torch.report.kinematic import kinematic_figures, select_row, snapshots
from apcc_torch.report.style import attempt, save_figures
from apcc_torch.simulation.divergence import Divergence, sentence
from apcc_torch.simulation.exact import simulate_exact
from apcc_torch.simulation.kinematic import KinematicLog, simulate_feedback
from apcc_torch.simulation.metrics import VelocityQuality, backbone_error, orientation_error, velocity_quality
from apcc_torch.simulation.progress import Progress

SHAPE_SAMPLES = 200
"""Largest number of instants at which the shape error is computed."""
FILM_FRAMES = 120
INSTANTS = 600
"""Largest number of instants of a run that is drawn anew; more would not be seen."""


class Outcome(NamedTuple):
    """What a run left: its log, the true rest lengths pi (n_b,) m, the arm with its sensors, and what judges it."""

    log: KinematicLog
    pi: Tensor
    controller: APCCController
    divergence: Divergence


def shape_errors(log: KinematicLog, backbone: KinematicModel, pi: Tensor) -> tuple[slice, Tensor]:
    """The instants at which the shape error is computed, S of them, and the error (S, R) m; see `kinematic_metrics`."""
    at = slice(None, None, max(1, log.time.shape[0] // SHAPE_SAMPLES))
    return at, backbone_error(backbone, log.q_true[at], pi, backbone, log.q_bar[at], log.pi_hat[at])


def causes(outcome: Outcome) -> tuple[Tensor, Tensor]:
    """Instants (S,) s, and the `Cause`s (S, R) by which each row has diverged until then."""
    log, pi, controller, _ = outcome
    at, shape = shape_errors(log, controller.backbone, pi)
    return log.time[at], _judged(outcome, at, shape)


def _judged(outcome: Outcome, at: slice, shape: Tensor) -> Tensor:
    log, pi, controller, divergence = outcome
    seen, backbone = KinematicLog(*(field[at] for field in log)), controller.backbone
    return divergence.of_arm(seen, shape, pi, backbone, backbone, controller.bounds if controller.adaptive else None)


def _angles(outcome: Outcome) -> Tensor:
    """Angles (T, R, k) rad of the model to the true orientations at the sensors; 0 where q is known without any."""
    log, pi, controller, _ = outcome
    # Algorithm 2 reports no angles where it fits positions alone.
    if controller.feedback.mode != "position" or not bool(log.linear_error.any()):
        return log.angular_error
    places = controller.feedback.abscissae
    true = controller.backbone.pose(log.q_true, pi, *decouple(places.to(pi), pi))
    return orientation_error(controller.backbone, log.q_bar, log.pi_hat, places, true[..., :3, :3])


def kinematic_metrics(outcome: Outcome) -> dict[str, float]:
    """Flat metrics of a run, SI units in the names; over all rows, and the worst row where a name says max.

    Args:
        outcome: Of one run, its log (T, R, ...).
    """
    log, pi, controller, _ = outcome
    backbone = controller.backbone
    last = log.time >= log.time[-1] - 5.0
    at, shape = shape_errors(log, backbone, pi)
    shape_end = backbone_error(backbone, log.q_true[-1], pi, backbone, log.q_bar[-1], log.pi_hat[-1])
    e = (log.x_d - log.x).norm(dim=-1)
    psi = elongation_cost(log.q_bar, coordinates=backbone.coordinates)
    gap = (log.pi_hat[-1] - pi).abs()
    velocity = _velocity(log, backbone)
    metrics = {
        "end_effector_error_end_mm": 1e3 * e[-1].mean(),
        "end_effector_error_end_max_mm": 1e3 * e[-1].max(),
        "end_effector_error_mean_mm": 1e3 * e.mean(),
        "end_effector_error_last5s_max_mm": 1e3 * e[last].max(),
        "shape_error_mean_mm": 1e3 * shape.mean(),
        "shape_error_max_mm": 1e3 * shape.max(),
        "shape_error_min_mm": 1e3 * shape.min(),
        "shape_error_end_mm": 1e3 * shape_end.mean(),
        "shape_error_end_max_mm": 1e3 * shape_end.max(),
        "shape_error_last5s_max_mm": 1e3 * shape[last[at]].max(),
        "velocity_lag_ms": 1e3 * velocity.lag.mean(),
        "velocity_noise_mmps": 1e3 * velocity.noise.mean(),
        "psi_mean_cm": 1e2 * psi.mean(),
        "psi_max_cm": 1e2 * psi.max(),
        "sensor_error_linear_mean_mm": 1e3 * log.linear_error.mean(),
        "sensor_error_angular_mean_rad": _angles(outcome).mean(),
        "pi_error_end_max_mm": 1e3 * gap.max(),
        **{f"pi_hat_{i + 1}_end_m": log.pi_hat[-1, 0, i] for i in range(pi.shape[0])},
        "rows": log.q_bar.shape[1],
        "diverged_rows": (_judged(outcome, at, shape)[-1] > 0).sum(),
    }
    return {name: float(value) for name, value in metrics.items()}


def _velocity(log: KinematicLog, backbone: KinematicModel) -> VelocityQuality:
    """How late and how noisy the tip's velocity is as the law of Eq. (15) sees it, over the run's second half."""
    half = slice(log.time.shape[0] // 2, None)
    dt = float(log.time[-1] - log.time[0]) / max(log.time.shape[0] - 1, 1)
    q_bar, pi_hat = log.q_bar[half], log.pi_hat[half]
    J_hat = backbone.tip_jacobian(q_bar, pi_hat)
    seen = (J_hat @ log.qdot_bar[half].unsqueeze(-1)).squeeze(-1)
    return velocity_quality(seen, torch.gradient(log.x[half], spacing=dt, dim=0)[0], dt)


def simulate(config: SimulateSettings, points: int | None = None, progress: Progress | None = None) -> Outcome:
    """Runs section V-A.

    Args:
        config: Settings; of several runs side by side, from `stacking.stacked`.
        points: How many runs; None for one. The log of P runs is (T, P, R, ...), and pi (P, 1, n_b) where they differ.
        progress: Wraps the step counter; None for a bar.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    build = Builder(config, points)
    controller = build.controller()
    pi = build.rest_lengths()
    run = (
        simulate_exact
        if config.state == "exact"
        else partial(
            simulate_feedback,
            sensors=build.pose_sensors(),
            generator=torch.Generator(build.device).manual_seed(config.seed),
            curvature_places=build.curvature_places(),
        )
    )
    with torch.inference_mode():
        log = run(
            controller,
            pi,
            _starts(config, build),
            build.sine(),
            config.experiment.duration,
            config.controller.rate,
            progress or progress_bar("section V-A", config.progress),
            config.compile,
        )
    return Outcome(log, pi, controller, build.divergence())


def one_of(outcome: Outcome, config: SimulateSettings, p: int) -> Outcome:
    """Run p, with its own settings, of runs side by side."""
    log = KinematicLog(*(field if field.dim() == 1 else field[:, p].contiguous() for field in outcome.log))
    build = Builder(config)
    return Outcome(log, build.rest_lengths(), build.controller(), build.divergence())


def metrics(outcome: Outcome) -> dict[str, float]:
    """Metrics of one run: the headline ones are row 0's, those named `all_rows_...` are over every row."""
    log = outcome.log
    with torch.inference_mode():
        values = kinematic_metrics(_first(outcome))
        if log.q_bar.shape[1] == 1:
            return values
        every = kinematic_metrics(outcome)
    values |= {f"all_rows_{name}": value for name, value in every.items() if "pi_hat" not in name}
    return values | {"rows": every["rows"], "diverged_rows": every["diverged_rows"]}


def _first(outcome: Outcome) -> Outcome:
    """Row 0 alone."""
    return outcome._replace(log=KinematicLog(*(field if field.dim() == 1 else field[:, :1] for field in outcome.log)))


def draw(outcome: Outcome, folder: Path) -> None:
    """Figures 7, 8 and 9 of one run."""
    log, pi, controller, _ = outcome
    figures = kinematic_figures(log, pi, controller.feedback.abscissae, controller.backbone)
    save_figures(figures, folder, warning=sentence(*causes(outcome)))


def arrays(outcome: Outcome) -> dict[str, Tensor]:
    """What trajectory.npz holds."""
    return {**outcome.log._asdict(), "pi": outcome.pi}


def loaded(config: SimulateSettings, data: Mapping[str, Tensor]) -> Outcome:
    """The outcome of a run from its trajectory.npz."""
    build = Builder(config)
    log = KinematicLog(*(data[name] for name in KinematicLog._fields))
    return Outcome(log, data["pi"], build.controller(), build.divergence())


def redraw(config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool) -> None:
    """See `kinds.Kind`."""
    outcome = loaded(config, arrays)
    T = outcome.log.time.shape[0]
    kept = torch.arange(T - 1, -1, -max(1, -(-T // INSTANTS))).flip(0)
    outcome = outcome._replace(log=KinematicLog(*(field[kept] for field in outcome.log)))
    if figured:
        draw(outcome, into)
    if filmed:
        with attempt("the film"):
            shots, readouts = film(outcome)
            warning = sentence(*causes(outcome))
            save_animation(into / "animation", shots, readouts, max_frames=FILM_FRAMES, warning=warning)


def film(outcome: Outcome) -> tuple[Snapshots, dict[str, Tensor]]:
    """The moments of row 0, and the errors that run along."""
    pi, backbone = outcome.pi, outcome.controller.backbone
    log = select_row(outcome.log, 0)
    end = float(log.time[-1])
    shots = snapshots(log, pi, outcome.controller.feedback.abscissae, backbone, end, FILM_FRAMES)
    at = torch.isin(log.time, shots.time)
    error = 1e3 * backbone_error(backbone, log.q_true[at], pi, backbone, log.q_bar[at], log.pi_hat[at])
    readouts = {"shape error (mm)": error, "end-effector error (mm)": 1e3 * (log.x_d - log.x)[at].norm(dim=-1)}
    return shots._replace(target=log.x_d[at]), readouts


def run(config: SimulateSettings, folder: Path) -> dict[str, float]:
    """Runs section V-A and writes its folder; returns the metrics.

    Row 0 starts from `experiment.first_estimate`; `experiment.start_errors` more rows start from random estimates.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    started = time.perf_counter()
    outcome = simulate(config)
    values = metrics(outcome)
    if values["diverged_rows"]:
        warn(sentence(*causes(outcome)))
    values["wall_s"] = time.perf_counter() - started
    RunFolder(folder).write(values, arrays(outcome), config.seed)
    if config.figures:
        draw(outcome, folder / "figures")
    return values


def _starts(config: SimulateSettings, build: Builder) -> Tensor:
    """(1 + start_errors, n_b) first estimates; of several runs (P, 1 + start_errors, n_b)."""
    e = config.experiment
    generator = torch.Generator().manual_seed(config.seed)
    draws = torch.rand(e.start_errors, build.n_sections, generator=generator, dtype=torch.float64)
    scale = (1.0 + e.start_error * (2.0 * draws - 1.0)).to(dtype=build.dtype, device=build.device)
    first, drawn = build.first_estimate(), build.rest_lengths() * scale
    if build.points is None:
        first = first.unsqueeze(0)
    return torch.cat((first, drawn.expand(*first.shape[:-2], *drawn.shape[-2:])), dim=-2)
