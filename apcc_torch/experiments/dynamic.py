"""Section V-B, Appendix A and tracking on the dynamic arm: settings to a folder with metrics, data and figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import true_parameters, with_dynamics
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import elongation_cost
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.experiments.dynamic_metrics import dynamic_metrics, effort_metrics, estimate_metrics
from apcc_torch.experiments.folder import RunFolder, progress_bar, warn
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.report.backbone_drawing import Snapshots, marker_positions, spread_indices
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.dynamics_parameters import dynamics_parameter_figure
from apcc_torch.report.run_figures import draw_run, in_sections, run_figures
from apcc_torch.simulation.divergence import Divergence, sentence
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.metrics import backbone_error, mapping_error, orientation_error
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.progress import Progress

INSTANTS = 200
"""Largest number of instants at which backbones are compared."""


class Arms(NamedTuple):
    """The true arm and the model of a run, and what judges whether they ran away."""

    true: KinematicModel
    true_lengths: Tensor  # (n_t,) m
    model: KinematicModel
    sensors: Tensor  # (k,) m
    theta: Tensor  # (R, 5) the true arm's `dynamics_regressor.PARAMETERS`
    divergence: Divergence
    bounds: LengthBounds | None  # of pi_hat, where it adapts
    period: float  # s, of a control step
    driven_lengths: Callable[[Tensor], Tensor]  # `APCCController.driven_lengths`


class Outcome(NamedTuple):
    """What a run left."""

    log: DynamicLog
    arms: Arms


def simulate(
    config: SimulateSettings,
    adaptive: bool | None = None,
    label: str = "",
    points: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Runs the whole grid, set-points by payloads, with one controller.

    Args:
        config: Settings; of several runs side by side, from `stacking.stacked`.
        adaptive: The A-PCC controller, or the standard one; None for the configured one.
        label: Of the progress bar.
        points: How many runs; None for one. The log of P runs is (T, P, R, ...).
        progress: Wraps the step counter; None for a bar.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    build = Builder(config, points)
    controller = with_dynamics(build, build.controller(adaptive))
    trajectory, payload = _rows(build)
    plant = build.plant(payload)
    settings = DynamicSettings(
        duration=config.experiment.duration, control_rate=config.controller.rate, compile=config.compile
    )
    generator = torch.Generator(build.device).manual_seed(config.seed)
    with torch.inference_mode():
        log = simulate_dynamic(
            plant,
            controller,
            build.pose_sensors(),
            trajectory,
            build.first_estimate(),
            settings,
            generator,
            progress or progress_bar(label, config.progress),
            build.true_sensors_at(),
            build.curvature_places(),
        )
    return Outcome(log, _arms_of(build, controller, plant))


def _rows(build: Builder) -> tuple[Trajectory, Tensor]:
    """The targets of all rows, and their payloads (R,) kg."""
    if build.config.experiment.setpoints is not None and len(build.config.experiment.setpoints) > 0:
        return build.grid()
    return build.sine(), build.payloads()


def one_of(outcome: Outcome, config: SimulateSettings, p: int) -> Outcome:
    """Run p, with its own settings, of runs side by side."""
    log = outcome.log
    fields = [field if field.dim() == 1 else field[:, p].contiguous() for field in log[:-1]]
    return Outcome(DynamicLog(*[*fields, log.diverged_at[p]]), _arms(config))


def loaded(config: SimulateSettings, data: Mapping[str, Tensor]) -> Outcome:
    """The outcome of a run from its trajectory.npz."""
    # Runs of before there was a law of the dynamics have no estimates of it.
    fields = {"theta_hat": data["u"][..., :0], **data}
    return Outcome(DynamicLog(*(fields[name] for name in DynamicLog._fields)), _arms(config))


def arrays(outcome: Outcome) -> dict[str, Tensor]:
    """What trajectory.npz holds."""
    return outcome.log._asdict()


def metrics(outcome: Outcome, c: RunCurves | None = None) -> dict[str, float]:
    """Metrics of one run; `c` are its `curves`, where they are there already."""
    c = curves(thinned(outcome.log), outcome.arms) if c is None else c
    return dynamic_metrics(c) | effort_metrics(outcome.log) | estimate_metrics(outcome.log, outcome.arms.theta)


def _arms(config: SimulateSettings) -> Arms:
    build = Builder(config)
    return _arms_of(build, build.controller(), build.plant(_rows(build)[1]))


def _arms_of(build: Builder, controller: APCCController | CompositeController, plant: Plant) -> Arms:
    kinematic = controller.kinematic if isinstance(controller, CompositeController) else controller
    end = torch.full_like(plant.payload, build.config.experiment.duration)
    return Arms(
        plant.backbone,
        plant.dynamics.lengths,
        kinematic.backbone,
        kinematic.feedback.abscissae,
        true_parameters(build, plant.events.payload(plant.payload, end)),
        build.divergence(),
        kinematic.bounds if kinematic.adaptive else None,
        1.0 / build.config.controller.rate,
        kinematic.driven_lengths,
    )


def thinned(log: DynamicLog, instants: int = INSTANTS) -> DynamicLog:
    """Every n-th row in time, the last one included, so that at most about `instants` are left."""
    T = log.time.shape[0]
    stride = max(1, -(-(T - 1) // instants))
    index = torch.arange(T - 1, -1, -stride, device=log.time.device).flip(0)
    return DynamicLog(*[*(field[index] for field in log[:-1]), log.diverged_at])


def curves(log: DynamicLog, arms: Arms) -> RunCurves:
    """The measures of the paper over time, at the instants of the log."""
    with torch.inference_mode():
        shape = backbone_error(arms.true, log.q_true, arms.true_lengths, arms.model, log.q_bar, log.pi_hat)
        mapped = mapping_error(arms.model, log.q_d, arms.driven_lengths(log.pi_hat), log.x)
        # Of all runs alike: algorithm 2 reports no angles where it fits positions alone.
        places = decouple(arms.sensors, arms.true_lengths)
        rotation = arms.true.pose(log.q_true, arms.true_lengths, *places)[..., :3, :3]
        angular = orientation_error(arms.model, log.q_bar, log.pi_hat, arms.sensors, rotation)
        left_at = torch.where(log.diverged_at < 0, torch.inf, arms.period * log.diverged_at)
        judged = (shape, arms.true_lengths, arms.true, arms.model, arms.bounds, left_at)
        diverged = arms.divergence.of_arm(log, *judged)
    return RunCurves(
        time=log.time,
        shape_error=shape,
        psi=elongation_cost(log.q_bar, coordinates=arms.model.coordinates),
        angular=angular,
        linear=log.linear_error,
        e=(log.x_d - log.x).norm(dim=-1),
        pi_hat=log.pi_hat,
        mapping_error=mapped,
        diverged=diverged,
    )


def snapshots(log: DynamicLog, arms: Arms, row: int, count: int | None) -> Snapshots:
    """Moments of one run: `count` of them spread over it, or all of the log's."""
    at = list(range(log.time.shape[0]))
    if count is not None:
        at = spread_indices(log.time, 0.0, float(log.time[-1]), count)
    q_true, q, pi_hat = log.q_true[at, row], log.q_bar[at, row], log.pi_hat[at, row]
    return Snapshots(
        log.time[at],
        arms.true.points(q_true, arms.true_lengths, 80),
        arms.model.points(q, pi_hat, 80),
        marker_positions(arms.true, q_true, arms.true_lengths, arms.sensors),
        marker_positions(arms.model, q, pi_hat, arms.sensors),
        log.x_d[at, row],
    )


def draw(outcome: Outcome, folder: Path, name: str = "run", c: RunCurves | None = None, title: str = "") -> None:
    """The paper's figures of one run, and a film of its last row.

    Args:
        outcome: The run.
        folder: Where they go.
        name: Of the run, in the legends.
        c: Its `curves`, where they are there already.
        title: Over the figures.
    """
    thin, arms = thinned(outcome.log), outcome.arms
    if c is None:
        c = curves(thin, arms)
    shots = snapshots(thin, arms, -1, None)
    drawings = run_figures(name, c, shots, in_sections(arms.true_lengths, arms.model.n_sections), title)
    if thin.theta_hat.shape[-1] > 0:
        drawings["dynamics.png"] = lambda: dynamics_parameter_figure(thin.time, thin.theta_hat, arms.theta, title=title)
    draw_run(folder, drawings, c, shots, sentence(c.time, c.diverged))


def redraw(config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool) -> None:
    """See `kinds.Kind`; figures and film are drawn together."""
    draw(loaded(config, arrays), into, _name(config), title=_title(config))


def run(config: SimulateSettings, folder: Path) -> dict[str, float]:
    """Runs the configured controller over the grid and writes its folder; returns the metrics.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    started = time.perf_counter()
    name = _name(config)
    outcome = simulate(config, label=f"{config.experiment.name}, {name}")
    c = curves(thinned(outcome.log), outcome.arms)
    values = metrics(outcome, c)
    warn(sentence(c.time, c.diverged))
    values["wall_s"] = time.perf_counter() - started
    RunFolder(folder).write(values, arrays(outcome), config.seed)
    if config.figures:
        draw(outcome, folder / "figures", name, c, _title(config))
    return values


def _title(config: SimulateSettings) -> str:
    return f"{config.experiment.name}, {config.arm.name}"


def _name(config: SimulateSettings) -> str:
    return "adaptive" if config.controller.adaptive else "standard"
