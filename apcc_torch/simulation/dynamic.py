"""The closed loop of section V-B: a plant of many sections under tendon PID, a controller with fewer, and its sensors.

Whole grids are one batch: set-points, payloads, controllers and gains are rows. The plant is stepped several times per
control period; the tendon PID acts at the plant's rate, as a motor's own loop does. Fig. 10 [Dalenberg].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.composite_controller import CompositeController, CompositeState
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.pid import TendonReference, ramp
from apcc_torch.control.step_io import ControllerState, Measurement
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.errors import ConfigError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.curvature import curvature_weights, middle_curvature
from apcc_torch.native.compiled import MODES, Step, compiled
from apcc_torch.part import Part, hold_rows, refuse_parameter, untrained
from apcc_torch.repetition import shared
from apcc_torch.settings import OURS, Settings, setting
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.plant_state import PlantState
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.rollout import rollout
from apcc_torch.simulation.sensors import Draws, PoseSensors, SensorState


@dataclass(frozen=True, kw_only=True)
class DynamicSettings(Settings):
    """How long a closed loop runs, and how.

    Example:
        >>> DynamicSettings(duration=5.0, control_rate=100.0).compile
        'off'
    """

    duration: float = setting(unit="s", meaning="after the arm has settled", above=0)
    control_rate: float = setting(unit="Hz", meaning="of the controller", above=0)
    compile: str = setting("off", "", OURS, "how a period is run; compiled code has no gradients", choices=MODES)
    checkpointed: bool = setting(False, "", OURS, "see `rollout`; the settling too")


class DynamicLog(NamedTuple):
    """A closed-loop run, time first; R rows.

    time: (T,) s. x_d, x: (T, R, 3) m. q_true: (T, R, 3 n_t). q_bar, q_d: (T, R, n). pi_hat: (T, R, n_b) m.
    angular_error, linear_error: (T, R, k) rad, m. status: (T, R) `FeedbackStatus`. y, y_d: (T, R, n_a) m.
    u: (T, R, n_a) N. pressure: (T, R, n_a) Pa, true ones of chambers; of tendons (T, R, 0). theta_hat: (T, R, p)
    parameters of the dynamics, `dynamics_regressor.PARAMETERS`; p = 0 where the controller has none. diverged_at: (R,)
    int64 control step at which a row left its bounds, -1 if it did not.
    """

    time: Tensor
    x_d: Tensor
    x: Tensor
    q_true: Tensor
    q_bar: Tensor
    q_d: Tensor
    pi_hat: Tensor
    angular_error: Tensor
    linear_error: Tensor
    status: Tensor
    y: Tensor
    y_d: Tensor
    u: Tensor
    pressure: Tensor
    theta_hat: Tensor
    diverged_at: Tensor


class LoopState(NamedTuple):
    """All that a closed loop remembers: the true arm, the controller, the sensors, the last command y (R, n_a), m.

    u: (R, n_a) tendon forces now, N, for a controller that measures them; None for others. pressure: (R, n_a) the last
    command to chambers, Pa; None of tendons.
    """

    plant: PlantState
    controller: ControllerState | CompositeState
    sensors: SensorState
    y: Tensor
    u: Tensor | None = None
    pressure: Tensor | None = None


class ClosedLoop(Part):
    """One control period of the closed loop, as one pure step: read the sensors, control, move the arm.

    Args:
        plant: The true arm.
        controller: With a routing, and its feedback at the sensors' abscissae.
        sensors: What the sensors make of the true poses.
        trajectory: Targets (R, 3).
        period: s.
        abscissae: (..., k) where the sensors really are, m; None for where the controller believes them.
        curvature_places: (..., n_c) abscissae where curvature is measured, m; None for nowhere.

    Raises:
        ConfigError: The controller has no routing, or does not drive what the plant is driven by.
    """

    X_tilde: Tensor
    j: Tensor
    curvature_weights: Tensor | None

    def __init__(
        self,
        plant: Plant,
        controller: APCCController | CompositeController,
        sensors: PoseSensors,
        trajectory: Trajectory,
        period: float,
        abscissae: Tensor | None = None,
        curvature_places: Tensor | None = None,
    ) -> None:
        super().__init__()
        if controller.routing is None:
            raise ConfigError("the controller of a dynamic simulation needs a tendon routing")
        if (plant.valves is None) != (not isinstance(controller, APCCController) or controller.pressure is None):
            raise ConfigError("a plant with chambers needs a controller that sets pressures, and only it takes them")
        self.plant = plant
        self.controller = controller
        self.sensors = sensors
        self.trajectory = trajectory
        self.period = period
        lengths = plant.dynamics.lengths
        refuse_parameter("abscissae", abscissae, "where the sensors are is made of them once; hand in a plain tensor")
        places = untrained(controller.feedback.abscissae) if abscissae is None else abscissae
        X_tilde, j = decouple(places.to(lengths), lengths)
        weights = None
        if curvature_places is not None:
            weights = curvature_weights(lengths, plant.refine, curvature_places.to(lengths))
        hold_rows(self, X_tilde=(X_tilde, 1), j=(j, 1), curvature_weights=(weights, 2))

    def curvature(self, q: Tensor) -> Tensor | None:
        """True curvature (..., n_c, 2) where it is measured, 1/m; None where it is not."""
        if self.curvature_weights is None:
            return None
        return self.curvature_weights @ middle_curvature(self.plant.backbone, q, self.plant.dynamics.lengths)

    def poses(self, q: Tensor) -> Tensor:
        """True poses of the sensors (..., k, 4, 4)."""
        return self.plant.backbone.pose(q, self.plant.dynamics.lengths, self.X_tilde, self.j)

    def start(self, arm: PlantState, pi_hat: Tensor, generator: torch.Generator | None = None) -> LoopState:
        """The loop on an arm at rest.

        Args:
            arm: The settled arm.
            pi_hat: (..., n_b) first estimates, m.
            generator: Of what is drawn once of the sensors; None for torch's global one.
        """
        T = self.poses(arm.arm.q)
        controller = self.controller
        q = torch.zeros(*T.shape[:-3], controller.backbone.n, dtype=T.dtype, device=T.device)
        # The arm hangs nearly straight; a few rounds of algorithm 2 leave no trace of the first guess.
        for _ in range(5):
            q = controller.feedback(q, pi_hat, T).q_bar
        state = controller.initial_state(q, pi_hat, torch.zeros((), dtype=T.dtype, device=T.device))
        y = controller.tendons(state.q_d, state.pi_hat)
        assert y is not None  # refused above
        u = None
        if isinstance(controller, CompositeController):
            # What held the settled arm: its tendons at their zero lengths.
            u = self.plant.forces(arm, self.plant.at_rest(arm.z))
        seen = self.sensors.initial_state(T, self.curvature(arm.arm.q), generator)
        return LoopState(arm, state, seen, y, u, self.plant.at_rest(arm.z).pressure)

    def blank(self) -> tuple[LoopState, Tensor, Tensor, Draws]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        lengths = self.plant.dynamics.lengths
        zero = torch.zeros((), dtype=lengths.dtype, device=lengths.device)
        arm = self.plant.straight(())
        y = arm.z
        model, k = self.controller.backbone, torch.zeros((), dtype=torch.int64, device=lengths.device)
        state = self.controller.initial_state(zero.expand(model.n), zero.expand(model.n_sections) + 0.1, zero)
        T = torch.eye(4, dtype=zero.dtype, device=zero.device).expand(self.j.shape[-1], 4, 4)
        chance = torch.Generator(T.device)
        sensors = self.sensors.initial_state(T, self.curvature(arm.arm.q), chance)
        u = y if isinstance(self.controller, CompositeController) else None
        now = LoopState(arm, state, sensors, y, u, self.plant.at_rest(y).pressure)
        return now, zero, k, self.draw(T[(None,) * self.sensors.shared], chance)

    def draw(self, T: Tensor, generator: torch.Generator | None) -> Draws:
        """The chance in one reading; see `PoseSensors.draw`."""
        n_curvature = 0 if self.curvature_weights is None else self.curvature_weights.shape[-2]
        return self.sensors.draw(T, generator, self.plant.B.shape[-1], n_curvature)

    def forward(self, now: LoopState, time: Tensor, k: Tensor, draws: Draws) -> tuple[LoopState, tuple[Tensor, ...]]:
        """The loop one period later, and the row of the log: `DynamicLog`'s fields without time and divergence.

        Args:
            now: The loop.
            time: () s.
            k: () int64, number of the period.
            draws: The chance in the sensors' reading.
        """
        plant, arm = self.plant, now.plant
        sensors, seen = self.sensors.sense(now.sensors, self.poses(arm.arm.q), self.curvature(arm.arm.q), draws)
        target, lengths = self.trajectory(time), plant.lengths(arm.arm.q)
        tendons, p = None, arm.held[..., :0]
        if plant.valves is None:  # chambers carry nothing that measures their lengths
            pull = plant.forces(arm, self._reference(now, now.y, 0.0)) if self.sensors.stretches else None
            tendons = self.sensors.measured_tendons(lengths, pull, draws)
        else:
            p = arm.held
        measurement = Measurement(seen.T, time, seen.mask, forces=now.u, tendons=tendons, curvature=seen.curvature)
        state, command = self.controller(now.controller, measurement, target)
        y, told = command.y, (command.force, command.pressure)
        assert y is not None  # the controller has a routing
        u = plant.forces(arm, self._reference(now, y, 0.0, *told))
        x = plant.backbone.tip(arm.arm.q, plant.dynamics.lengths)
        feedback = command.feedback
        row = (
            target.x_d.expand_as(x),
            x,
            arm.arm.q,
            feedback.q_bar,
            state.q_d,
            now.controller.pi_hat,
            feedback.angular_error,
            feedback.linear_error,
            feedback.status,
            lengths,
            now.y,
            u,
            p,
        )
        for i in range(plant.substeps):
            reference = self._reference(now, y, (i + 1) / plant.substeps, *told)
            arm = shared(plant.advance, arm, reference, self.period / plant.substeps, k)
        measured = None
        if now.u is not None:
            measured = plant.forces(arm, self._reference(now, y, 1.0, *told))
        return LoopState(arm, state, sensors, y, measured, command.pressure), row

    def rollouts(self, compile: str, rows: int = 1) -> Step | None:
        """See `LookaheadController.rollouts`; None of a controller that does not look ahead."""
        controller = self.controller
        return controller.rollouts(compile, rows) if isinstance(controller, LookaheadController) else None

    def look_ahead(self, now: LoopState, time: Tensor, run: Step | None) -> LoopState:
        """The loop once its controller has looked ahead from the period that began at `time` () s, if it does."""
        if not isinstance(self.controller, LookaheadController) or isinstance(now.controller, CompositeState):
            return now
        return now._replace(controller=self.controller.look_ahead(now.controller, self.trajectory(time), run))

    def _reference(
        self, now: LoopState, y: Tensor, share: float, force: Tensor | None = None, pressure: Tensor | None = None
    ) -> TendonReference:
        """What motors or valves are told after a share of the period in which y (..., n_a) m is commanded."""
        return ramp(now.y, y, share, self.period, force, pressure)


def simulate_dynamic(
    plant: Plant,
    controller: APCCController | CompositeController,
    sensors: PoseSensors,
    trajectory: Trajectory,
    pi_hat: Tensor,
    settings: DynamicSettings,
    generator: torch.Generator | None = None,
    progress: Progress = quiet,
    abscissae: Tensor | None = None,
    curvature_places: Tensor | None = None,
) -> DynamicLog:
    """Runs the closed loop for all rows at once.

    Args:
        plant: The true arm.
        controller: With a routing, and its feedback at the sensors' abscissae.
        sensors: What the sensors make of the true poses.
        trajectory: Targets (R, 3).
        pi_hat: (..., n_b) first estimates, m.
        settings: Rates and times, and how the loop is run.
        generator: Source of the sensors' noise.
        progress: Wraps the control-step counter, for a progress bar.
        abscissae, curvature_places: See `ClosedLoop`.

    Raises:
        ConfigError: The controller has no routing.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> controller = APCCController.for_arm(arm)
        >>> target = SetPoint(torch.tensor([[0.05, 0.0, -0.44]]).double())
        >>> plant = Plant.on(arm, torch.tensor([0.1]).double(), PlantSettings(settle=0.5))
        >>> settings = DynamicSettings(duration=1.0, control_rate=25.0)
        >>> log = simulate_dynamic(plant, controller, PoseSensors(), target, arm.rest_lengths(), settings)
        >>> log.q_true.shape, bool((log.x - log.x_d)[-1].norm() < (log.x - log.x_d)[0].norm())
        (torch.Size([26, 1, 12]), True)
    """

    def estimated(now: LoopState) -> Tensor:
        if isinstance(now.controller, CompositeState):
            return now.controller.theta_hat
        return now.y[..., :0]

    period = 1.0 / settings.control_rate
    loop = ClosedLoop(plant, controller, sensors, trajectory, period, abscissae, curvature_places)
    _, time, k, _ = example = loop.blank()
    step = compiled(loop, example, settings.compile, plant.payload.numel())
    run = loop.rollouts(settings.compile, plant.payload.numel())
    arm = plant.settled(plant.settle, period / plant.substeps, settings.compile, settings.checkpointed)
    now = loop.start(arm, pi_hat, generator)
    poses = now.sensors.queue[..., 0, :, :, :]

    def arguments(index: int) -> tuple[Tensor, Tensor, Draws]:
        return time + index * period, k + index, loop.draw(poses, generator)

    def one(now: LoopState, time: Tensor, k: Tensor, draws: Draws) -> tuple[LoopState, tuple[Tensor, ...]]:
        before = now
        now, row = step(now, time, k, draws)
        return loop.look_ahead(now, time, run), (time, *row, estimated(before))

    steps = round(settings.duration * settings.control_rate) + 1
    now, fields = rollout(one, now, arguments, steps, settings.checkpointed, progress)
    return DynamicLog(*[*fields, now.plant.diverged_at])
