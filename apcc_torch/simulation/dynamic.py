"""The closed loop of section V-B: a plant of many sections under tendon PID, a controller with fewer, and its sensors.

Whole grids are one batch: set-points, payloads, controllers and gains are rows. The plant is stepped several times per
control period; the tendon PID acts at the plant's rate, as a motor's own loop does. Fig. 10 [Dalenberg].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.pid import TendonPID, TendonReference, ramp
from apcc_torch.control.signals import Command, ControllerState, Measurement
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import EquationOfMotion, SoftArmDynamics
from apcc_torch.model.friction import TendonTransmission
from apcc_torch.model.integrators import Actuation, ArmState, guard, semi_implicit_step
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.rows import Rows
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.simulation.trajectory import Trajectory


@dataclass(frozen=True)
class DynamicSettings:
    """Rates and times of a closed-loop run.

    duration: s after the arm has settled.
    control_rate: Hz.
    substeps: Plant steps in one control period.
    settle: s during which the tendons hold their zero lengths and the arm comes to rest under gravity.
    """

    duration: float = 10.0
    control_rate: float = 100.0
    substeps: int = 4
    settle: float = 3.0

    def __post_init__(self) -> None:
        """Raises ValueRangeError where a time or rate is not positive."""
        for name in ("duration", "control_rate", "substeps"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueRangeError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not 0 <= self.settle < float("inf"):
            raise ValueRangeError(f"settle must be zero or positive, got {self.settle}")


class DynamicLog(NamedTuple):
    """A closed-loop run, time first; R rows.

    time: (T,) s. x_d, x: (T, R, 3) m. q_true: (T, R, 3 n_t). q_bar, q_d: (T, R, 3 n_b). pi_hat: (T, R, n_b) m.
    angular_error, linear_error: (T, R, k) rad, m. status: (T, R) `FeedbackStatus`. y, y_d: (T, R, n_a) m.
    u: (T, R, n_a) N. diverged_at: (R,) int64 control step at which a row left its bounds, -1 if it did not.
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
    diverged_at: Tensor


class PlantState(NamedTuple):
    """The arm, the integral z (R, n_a) of its tendon loop, m s, and when each row diverged (R,), see `DynamicLog`."""

    arm: ArmState
    z: Tensor
    diverged_at: Tensor


class Plant:
    """The true arm and its tendon loop.

    Args:
        dynamics: The arm.
        routing: Its tendons.
        pid: The loop on their lengths.
        payload: (..., R) tip mass, kg.
        tendon_damping: Viscous friction of each tendon in its guides, N s/m, a number or (...) one a row.
        transmission: Slack and dry friction between the motors and the arm; None: the arm feels the motors' forces.
        bound: Largest magnitude of a coordinate or its rate before a row counts as diverged.

    Raises:
        ConfigError: The dynamics' base rotation is batched.
    """

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        pid: TendonPID,
        payload: Tensor,
        tendon_damping: Setting = 0.0,
        transmission: TendonTransmission | None = None,
        bound: float = 1e3,
    ) -> None:
        check_setting("tendon_damping", tendon_damping, zero=True)
        if dynamics.base_rotation.dim() != 2:
            raise ConfigError("base_rotation of the plant must be one (3, 3) rotation, shared by all rows")
        self.dynamics = dynamics
        self.pid = pid
        self.payload = payload
        self.tendon_damping = tendon_damping
        self.transmission = transmission
        self.bound = bound
        self.backbone = PCCBackbone(dynamics.n_sections, dynamics.base_rotation)
        self.B = routing.matrix(dynamics.lengths)
        stiff = self.B @ self.B.mT
        self.actuation_stiffness = aligned(pid.K_P, 2) * stiff
        self.actuation_damping = aligned(pid.K_D + tendon_damping, 2) * stiff

    def lengths(self, v: Tensor) -> Tensor:
        """B^T v: tendon length changes (..., n_a) of a configuration, or their rates of a velocity."""
        return (self.B.mT @ v.unsqueeze(-1)).squeeze(-1)

    def _pull(self, u: Tensor) -> Tensor:
        """B u: the generalized force (..., n) of forces (..., n_a)."""
        return (self.B @ u.unsqueeze(-1)).squeeze(-1)

    def forces(self, state: ArmState, z: Tensor, reference: TendonReference) -> Tensor:
        """Forces u (..., n_a) of the tendon loop, N."""
        return self.pid(z, self.lengths(state.q), self.lengths(state.qdot), reference.y_d, reference.ydot_d)

    def step(self, state: ArmState, z: Tensor, reference: TendonReference, dt: float) -> tuple[ArmState, Tensor]:
        """One plant step of order 2: linearly implicit Euler over dt and twice over dt/2, extrapolated.

        Tendon damping makes the plant stiff, with an M(q) that changes on the way. Every Euler step takes M where it
        starts and is stable; a Rosenbrock method, which keeps one M for both its stages, is not at the same dt.

        Args:
            state: The arm.
            z: (R, n_a) integral of the tendon loop, m s.
            reference: At the step's end; the step's references lie on the straight line that leads there.
            dt: Step, s.

        Returns:
            The arm and the integral after the step.
        """
        half = 0.5 * dt
        midway = TendonReference(reference.y_d - half * reference.ydot_d, reference.ydot_d)
        equation = self.dynamics.equation(state.q, state.qdot, self.payload)
        whole, z_whole = self._euler(state, z, reference, dt, equation)
        middle, z_middle = self._euler(state, z, midway, half, equation)
        halves, z_halves = self._euler(middle, z_middle, reference, half, None)
        later = ArmState(2.0 * halves.q - whole.q, 2.0 * halves.qdot - whole.qdot)
        return later, 2.0 * z_halves - z_whole

    def _euler(
        self, state: ArmState, z: Tensor, reference: TendonReference, dt: float, equation: EquationOfMotion | None
    ) -> tuple[ArmState, Tensor]:
        """One linearly implicit Euler step under the reference of its end."""
        u, drag = self.forces(state, z, reference), aligned(self.tendon_damping, 1) * self.lengths(state.qdot)
        if self.transmission is None:
            tau = self._pull(u - drag)
        else:
            tau = self.transmission(u, state.q, state.qdot, self.dynamics.lengths) - self._pull(drag)
        actuation = Actuation(tau, self.actuation_stiffness, self.actuation_damping)
        later = semi_implicit_step(self.dynamics, state, actuation, dt, self.payload, equation=equation)
        return later, self.pid.integrate(z, self.lengths(later.q), reference.y_d, dt)

    def advance(self, now: PlantState, reference: TendonReference, dt: float, k: int) -> PlantState:
        """`step` for the rows that are good; a row that leaves its bounds in control step k stays where it was."""
        moved, z = self.step(now.arm, now.z, reference, dt)
        kept, diverged_at = guard(torch.cat(now.arm, dim=-1), torch.cat(moved, dim=-1), now.diverged_at, k, self.bound)
        z = torch.where((diverged_at < 0).unsqueeze(-1), z, now.z)
        return PlantState(ArmState(*kept.split(self.backbone.n, dim=-1)), z, diverged_at)

    def settled(self, duration: float, dt: float) -> PlantState:
        """The arm at rest under gravity with its tendons held at their zero lengths.

        Args:
            duration: How long it may take, s.
            dt: Step, s.
        """
        zero = torch.zeros(*self.payload.shape, self.backbone.n, dtype=self.payload.dtype, device=self.payload.device)
        z = torch.zeros_like(self.lengths(zero))
        good = torch.full(self.payload.shape, -1, dtype=torch.int64, device=self.payload.device)
        now = PlantState(ArmState(zero, zero), z, good)
        hold = TendonReference(torch.zeros_like(z), torch.zeros_like(z))
        for _ in range(round(duration / dt)):
            now = self.advance(now, hold, dt, 0)
        return now


def simulate_dynamic(
    plant: Plant,
    controller: APCCController,
    sensors: PoseSensors,
    trajectory: Trajectory,
    pi_hat: Tensor,
    settings: DynamicSettings,
    generator: torch.Generator | None = None,
    progress: Progress = quiet,
) -> DynamicLog:
    """Runs the closed loop for all rows at once.

    Args:
        plant: The true arm.
        controller: With a routing, and its feedback at the sensors' abscissae.
        sensors: What the sensors make of the true poses.
        trajectory: Targets (R, 3).
        pi_hat: (..., n_b) first estimates, m.
        settings: Rates and times.
        generator: Source of the sensors' noise.
        progress: Wraps the control-step counter, for a progress bar.

    Raises:
        ConfigError: The controller has no routing.
    """
    if controller.routing is None:
        raise ConfigError("the controller of a dynamic simulation needs a tendon routing")
    period = 1.0 / settings.control_rate
    dt = period / settings.substeps
    now = plant.settled(settings.settle, dt)
    q = now.arm.q
    X_tilde, j = decouple(controller.feedback.abscissae.to(q), plant.dynamics.lengths)
    start = torch.zeros((), dtype=q.dtype, device=q.device)

    def poses(q: Tensor) -> Tensor:
        return plant.backbone.pose(q, plant.dynamics.lengths, X_tilde, j)

    sensor_state = sensors.initial_state(poses(q))
    state = _first_state(controller, poses(q), pi_hat, start)
    y_last = controller.routing.lengths(state.q_d, state.pi_hat)
    steps = round(settings.duration * settings.control_rate) + 1
    log = Rows(steps)
    for k in progress(range(steps)):
        time = start + k * period
        sensor_state, seen, mask = sensors(sensor_state, poses(now.arm.q), generator)
        target = trajectory(time)
        pi_before = state.pi_hat
        state, command = controller(state, Measurement(seen, time, mask), target)
        y = command.y
        assert y is not None  # the controller has a routing
        u = plant.forces(now.arm, now.z, ramp(y_last, y, 0.0, period))
        log.add(_row(time, target.x_d, plant, now.arm, pi_before, state, command, y_last, u))
        for i in range(settings.substeps):
            now = plant.advance(now, ramp(y_last, y, (i + 1) / settings.substeps, period), dt, k)
        y_last = y
    return DynamicLog(*[*log.stacked(), now.diverged_at])


def _first_state(controller: APCCController, T: Tensor, pi_hat: Tensor, time: Tensor) -> ControllerState:
    """The controller's state on the settled arm: q_bar as the sensors see it, from a straight first guess."""
    q = torch.zeros(*T.shape[:-3], controller.backbone.n, dtype=T.dtype, device=T.device)
    # The arm hangs nearly straight; a few rounds of algorithm 2 leave no trace of the first guess.
    for _ in range(5):
        q = controller.feedback(q, pi_hat, T).q_bar
    return controller.initial_state(q, pi_hat, time)


def _row(
    time: Tensor,
    x_d: Tensor,
    plant: Plant,
    arm: ArmState,
    pi_hat: Tensor,
    state: ControllerState,
    command: Command,
    y_d: Tensor,
    u: Tensor,
) -> tuple[Tensor, ...]:
    feedback = command.feedback
    x = plant.backbone.tip(arm.q, plant.dynamics.lengths)
    return (
        time,
        x_d.expand_as(x),
        x,
        arm.q,
        feedback.q_bar,
        state.q_d,
        pi_hat,
        feedback.angular_error,
        feedback.linear_error,
        feedback.status,
        plant.lengths(arm.q),
        y_d,
        u,
    )
