"""The true arm of section V-B: many sections under tendons, whose lengths a PID loop holds. Fig. 10 [Dalenberg]."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.control.pid import TendonPID, TendonReference
from apcc_torch.errors import ConfigError
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import EquationOfMotion, SoftArmDynamics
from apcc_torch.model.friction import TendonTransmission
from apcc_torch.model.integrators import Actuation, ArmState, guard, semi_implicit_step
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.native.compiled import Step, compiled
from apcc_torch.part import hold, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.simulation.rollout import rollout


class PlantState(NamedTuple):
    """The arm, the integral z (R, n_a) of its tendon loop, m s, and when each row diverged (R,), see `DynamicLog`."""

    arm: ArmState
    z: Tensor
    diverged_at: Tensor


class Plant(nn.Module):
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

    payload: Tensor
    B: Tensor
    actuation_stiffness: Tensor
    actuation_damping: Tensor
    tendon_damping: Setting

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
        super().__init__()
        check_setting("tendon_damping", tendon_damping, zero=True)
        if dynamics.base_rotation.dim() != 2:
            raise ConfigError("base_rotation of the plant must be one (3, 3) rotation, shared by all rows")
        self.dynamics = dynamics
        self.routing = routing
        self.pid = pid
        hold(self, payload=payload, tendon_damping=tendon_damping)
        self.transmission = transmission
        self.bound = bound
        self.backbone = PCCBackbone(dynamics.n_sections, dynamics.base_rotation)
        B = routing.matrix(dynamics.lengths)
        stiffness, damping = (aligned(gain, 2) * (B @ B.mT) for gain in (pid.K_P, pid.K_D + tendon_damping))
        hold_rows(self, B=(B, 2), actuation_stiffness=(stiffness, 2), actuation_damping=(damping, 2))

    def lengths(self, v: Tensor) -> Tensor:
        """B^T v: tendon length changes (..., n_a) of a configuration, or their rates of a velocity."""
        return (self.B.mT @ v.unsqueeze(-1)).squeeze(-1)

    def _pull(self, u: Tensor) -> Tensor:
        """B u: the generalized force (..., n) of forces (..., n_a)."""
        return (self.B @ u.unsqueeze(-1)).squeeze(-1)

    def forces(self, state: ArmState, z: Tensor, reference: TendonReference) -> Tensor:
        """Forces u (..., n_a) of the tendon loop, N."""
        return self.pid(
            z, self.lengths(state.q), self.lengths(state.qdot), reference.y_d, reference.ydot_d, reference.force
        )

    def tensions(self, now: PlantState, reference: TendonReference) -> Tensor:
        """What the motors feel (..., n_a), N; a tendon that may be slack does not push."""
        u = self.forces(now.arm, now.z, reference)
        return torch.relu(-u) if self.transmission is not None and self.transmission.slack else -u

    def limp(self) -> Plant:
        """The same arm with motors that have no torque."""
        loop = TendonPID(0.0, 0.0, 0.0)
        return Plant(
            self.dynamics, self.routing, loop, self.payload, self.tendon_damping, self.transmission, self.bound
        )

    def stepper(self, dt: float, compile: str = "off") -> Step:
        """One step of `dt`, s, run as `compile` says, see `native.compiled`."""
        one = PlantStep(self, dt)
        return compiled(one, one.blank(), compile)

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
        midway = reference._replace(y_d=reference.y_d - half * reference.ydot_d)
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

    def advance(self, now: PlantState, reference: TendonReference, dt: float, k: int | Tensor) -> PlantState:
        """`step` for the rows that are good; a row that leaves its bounds in control step k stays where it was."""
        moved, z = self.step(now.arm, now.z, reference, dt)
        kept, diverged_at = guard(torch.cat(now.arm, dim=-1), torch.cat(moved, dim=-1), now.diverged_at, k, self.bound)
        z = torch.where((diverged_at < 0).unsqueeze(-1), z, now.z)
        return PlantState(ArmState(*kept.split(self.backbone.n, dim=-1)), z, diverged_at)

    def settled(self, duration: float, dt: float, compile: str = "off", checkpointed: bool = False) -> PlantState:
        """The arm at rest under gravity with its tendons held at their zero lengths.

        Args:
            duration: How long it may take, s.
            dt: Step, s.
            compile: How the steps are run, see `native.compiled`.
            checkpointed: See `rollout`.
        """
        straight = self.straight(self.payload.shape)
        steps = round(duration / dt)
        if not steps:
            return straight
        one = PlantStep(self, dt)
        step = compiled(one, one.blank(), compile, self.payload.numel(), carries=True)
        held = TendonReference(straight.z, straight.z)
        if checkpointed:
            return rollout(lambda now: (step(now, held), ()), straight, lambda k: (), steps, checkpointed)[0]
        return step(straight, held, repeats=steps)

    def straight(self, batch: tuple[int, ...]) -> PlantState:
        """Straight arms without motion, tendons at their zero lengths."""
        lengths = self.dynamics.lengths
        q = torch.zeros(*batch, self.backbone.n, dtype=lengths.dtype, device=lengths.device)
        z = torch.zeros(*batch, self.B.shape[-1], dtype=lengths.dtype, device=lengths.device)
        return PlantState(ArmState(q, q), z, torch.full(batch, -1, dtype=torch.int64, device=lengths.device))


class PlantStep(nn.Module):
    """One step of an arm towards a reference of its tendons.

    Args:
        plant: The arm.
        dt: Step, s.
    """

    def __init__(self, plant: Plant, dt: float) -> None:
        super().__init__()
        self.plant = plant
        self.dt = dt

    def blank(self) -> tuple[PlantState, TendonReference]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        now = self.plant.straight(())
        return now, TendonReference(now.z, now.z)

    def forward(self, now: PlantState, reference: TendonReference) -> PlantState:
        """The arm one step later."""
        return self.plant.advance(now, reference, self.dt, 0)
