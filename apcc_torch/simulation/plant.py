"""The true arm of section V-B: many sections under tendons, whose lengths a PID loop holds. Fig. 10 [Dalenberg].

An arm with chambers is the same arm: their pressures are forces on the same B, and there is no loop on their lengths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from apcc_torch.control.pid import TendonPID, TendonPIDSettings, TendonReference
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_changes import ArmChanges, with_changes
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.equation_of_motion import EquationOfMotion
from apcc_torch.model.friction import TendonTransmission, TendonTransmissionSettings
from apcc_torch.model.integrators import Actuation, ArmState, guard, semi_implicit_step
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.native.compiled import Step, compiled
from apcc_torch.part import Part, hold_rows, refuse_parameter
from apcc_torch.reading import keyed
from apcc_torch.settings import MANY, OURS, PAPER, Setting, Settings, aligned, resolved, setting
from apcc_torch.simulation.events import ArmEvents, ArmEventsSettings
from apcc_torch.simulation.plant_state import PlantState
from apcc_torch.simulation.play import played
from apcc_torch.simulation.rollout import rollout
from apcc_torch.simulation.true_places import PlaceErrors
from apcc_torch.simulation.valves import Valves


@dataclass(frozen=True, kw_only=True)
class PlantSettings(Settings):
    """Settings of `Plant`, and of the arm that it is made from."""

    tendon_damping: Setting = setting(
        200.0,
        "N s/m",
        OURS,
        "viscous friction of each tendon in its guides",
        rows="number",
        least=0,
    )
    pid: TendonPIDSettings = setting(factory=TendonPIDSettings, meaning="the loop on the tendons' lengths")
    transmission: TendonTransmissionSettings | None = setting(
        None, "", PAPER, "slack and dry friction between motors and arm; null: the arm feels the motors' forces"
    )
    backlash: Setting = setting(
        0.0, "m", OURS, "play between each motor and its tendon, as tendon length", rows="number", least=0
    )
    events: ArmEventsSettings = setting(factory=ArmEventsSettings, meaning="what happens to the true arm during a run")
    places: PlaceErrors = setting(
        factory=PlaceErrors, meaning="by how much sensors and tendons are off, beyond what `arm` says"
    )
    arm: ArmChanges = setting(factory=ArmChanges, meaning="what differs on the true arm from what is believed of it")
    refine: int = setting(2, "", PAPER, "sections of the true arm in one of the model's", least=1, most=100)
    substeps: int = setting(2, "", OURS, "plant steps in one control period", least=1, most=MANY)
    settle: float = setting(3.0, "s", OURS, "at rest under gravity before the clock starts", least=0)
    bound: float = setting(
        1e3, "rad, m, 1/s", OURS, "of a coordinate or its rate, beyond which a row has diverged", above=0, key=False
    )

    def true_arm(self, arm: Arm) -> Arm:
        """The plant's arm, of one that is believed to be `arm`."""
        with keyed("arm"):
            true = with_changes(arm, self.arm)
        with keyed("places"):
            return self.places.on(true)


class Plant(Part):
    """The true arm and its tendon loop.

    Args:
        dynamics: The arm.
        routing: Its tendons.
        pid: The loop on their lengths; None for that of the settings.
        payload: (..., R) tip mass, kg.
        *settings, **changes: See `PlantSettings`.
        transmission: Slack and dry friction; None for that of the settings.
        valves: Of chambers, which drive the arm in place of tendons on motors; None for these.

    Raises:
        ConfigError: The dynamics' base rotation is batched.

    Example:
        >>> plant = Plant.on(Arm(lengths=[0.2, 0.25]), torch.tensor([0.0, 0.2]).double(), PlantSettings())
        >>> plant.straight((2,)).arm.q.shape
        torch.Size([2, 12])
    """

    settings_type = PlantSettings
    payload: Tensor
    B: Tensor
    actuation_stiffness: Tensor
    actuation_damping: Tensor
    tendon_damping: Setting
    backlash: Setting
    refine: int
    substeps: int
    settle: float
    bound: float

    def __init__(
        self,
        dynamics: ArmDynamics,
        routing: TendonRouting,
        pid: TendonPID | None,
        payload: Tensor,
        *settings: Any,
        transmission: TendonTransmission | None = None,
        valves: Valves | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(type(self).settings_type, settings, changes)
        if dynamics.base_rotation.dim() != 2:
            raise ConfigError("base_rotation of the plant must be one (3, 3) rotation, shared by all rows")
        self.dynamics = dynamics
        self.routing = routing
        if valves is not None:  # nothing but their pressure acts on the arm: no loop, no guides, no play
            pid, transmission = TendonPID(K_P=0.0, K_I=0.0, K_D=0.0), None
            s = s.changed(pid=pid.settings, tendon_damping=0.0, backlash=0.0, transmission=None)
        self.pid = TendonPID(s.pid) if pid is None else pid
        if transmission is None and s.transmission is not None:
            transmission = TendonTransmission(routing, s.transmission)
        self.transmission = transmission
        self.valves = valves
        self.events = ArmEvents(dynamics.n_sections, s.events)
        self.backbone = dynamics.kinematics()
        self.hold(s)
        B = self.backbone.tendon_matrix(routing, dynamics.lengths)
        made_of = {"dynamics.lengths": dynamics.lengths, "tendon_damping": s.tendon_damping}
        for name, value in (*routing.named_parameters("routing"), *self.pid.named_parameters("pid"), *made_of.items()):
            refuse_parameter(name, value, "B and K_P B B^T of a plant are made of it once; hand in a plain tensor")
        gains = (self.pid.K_P, self.pid.K_D + s.tendon_damping)
        stiffness, damping = (aligned(gain, 2) * (B @ B.mT) for gain in gains)
        hold_rows(self, payload=(payload, 0), B=(B, 2))
        hold_rows(self, actuation_stiffness=(stiffness, 2), actuation_damping=(damping, 2))

    @classmethod
    def on(cls, arm: Arm, payload: Tensor, settings: PlantSettings) -> Self:
        """The plant of an arm, with what differs on the true one.

        Args:
            arm: As it is believed to be.
            payload: (..., R) kg.
            settings: Of `settings_type`.
        """
        true = settings.true_arm(arm)
        valves = None if true.chambers is None else Valves.of(true)
        return cls(cls.dynamics_of(true, settings), true.routing(), None, payload, settings, valves=valves)

    @staticmethod
    def dynamics_of(arm: Arm, settings: Any) -> ArmDynamics:
        """The dynamics of a true arm, with its plant's own settings."""
        return arm.dynamics(settings.refine)

    @property
    def sets_pressure(self) -> bool:
        """Whether chambers drive it."""
        return self.valves is not None

    def limp(self) -> Self:
        """The same arm without torque on its motors: its tendons are dragged along. Chambers are vented by command."""
        if self.valves is not None:
            return self
        loose = TendonPID(K_P=0.0, K_I=0.0, K_D=0.0)
        rest = {"transmission": None, "pid": TendonPIDSettings()}
        settings = self.settings.changed(**rest)
        return type(self)(self.dynamics, self.routing, loose, self.payload, settings, transmission=self.transmission)

    def tensions(self, now: PlantState, reference: TendonReference) -> Tensor:
        """What the motors feel (..., n_a), N; a tendon that may be slack does not push."""
        u = self.forces(now, reference)
        return torch.relu(-u) if self.transmission is not None and self.transmission.slack else -u

    def stepper(self, dt: float, compile: str) -> Step:
        """Steps of dt seconds as (state, reference) -> state, run as `native.compiled` says."""
        step = PlantStep(self, dt)
        return compiled(step, step.blank(), compile, self.payload.numel())

    def lengths(self, v: Tensor) -> Tensor:
        """B^T v: tendon length changes (..., n_a) of a configuration, or their rates of a velocity."""
        return (self.B.mT @ v.unsqueeze(-1)).squeeze(-1)

    def _pull(self, u: Tensor) -> Tensor:
        """B u: the generalized force (..., n) of forces (..., n_a)."""
        return (self.B @ u.unsqueeze(-1)).squeeze(-1)

    def forces(self, now: PlantState, reference: TendonReference) -> Tensor:
        """Forces u (..., n_a) of the tendon loop, N, with the motors at a reference."""
        return self._forces(now.arm, now.z, self._transmitted(now, reference, 0.0))

    def at_rest(self, z: Tensor) -> TendonReference:
        """Tendons, of the form of z (..., n_a), at their zero lengths, and chambers at their pressures of rest."""
        rest = None if self.valves is None else self.valves.at_rest.to(z).expand_as(z)
        return TendonReference(torch.zeros_like(z), torch.zeros_like(z), pressure=rest)

    def _forces(self, state: ArmState, z: Tensor, reference: TendonReference) -> Tensor:
        y, ydot = self.lengths(state.q), self.lengths(state.qdot)
        return self.pid(z, y, ydot, reference.y_d, reference.ydot_d, reference.force)

    def _transmitted(self, now: PlantState, reference: TendonReference, dt: float) -> TendonReference:
        """What reaches the arm, dt seconds later, of what motors or valves are told."""
        if self.valves is not None:
            return self.valves.transmitted(now.held, reference, dt)
        return played(now.held, reference, self.backlash)

    def step(self, now: PlantState, reference: TendonReference, dt: float) -> PlantState:
        """One plant step of order 2: linearly implicit Euler over dt and twice over dt/2, extrapolated.

        Tendon damping makes the plant stiff, with an M(q) that changes on the way. Every Euler step takes M where it
        starts and is stable; a Rosenbrock method, which keeps one M for both its stages, is not at the same dt.

        Args:
            now: The true arm.
            reference: Of the motors at the step's end; the step's references lie on the straight line that leads there.
            dt: Step, s.

        Returns:
            The true arm after the step; whether it diverged is not looked at.
        """
        half, state, time = 0.5 * dt, now.arm, now.time
        midway, reference = (self._transmitted(now, reference, each) for each in (half, dt))
        midway = midway._replace(y_d=reference.y_d - half * reference.ydot_d)
        payload = self.events.payload(self.payload, time)
        equation = self.dynamics.equation(state.q, state.qdot, payload)
        whole, z_whole = self._euler(state, now.z, reference, dt, payload, time + dt, equation)
        middle, z_middle = self._euler(state, now.z, midway, half, payload, time + half, equation)
        halves, z_halves = self._euler(middle, z_middle, reference, half, payload, time + dt, None)
        later = ArmState(2.0 * halves.q - whole.q, 2.0 * halves.qdot - whole.qdot)
        held = reference.y_d if reference.pressure is None else reference.pressure
        return PlantState(later, 2.0 * z_halves - z_whole, now.diverged_at, time + dt, held)

    def _euler(
        self,
        state: ArmState,
        z: Tensor,
        reference: TendonReference,
        dt: float,
        payload: Tensor,
        time: Tensor,
        equation: EquationOfMotion | None,
    ) -> tuple[ArmState, Tensor]:
        """One linearly implicit Euler step under the reference of its end, at `time`."""
        u, drag = self._forces(state, z, reference), aligned(self.tendon_damping, 1) * self.lengths(state.qdot)
        if self.transmission is None:
            tau = self._pull(u - drag)
        else:
            tau = self.transmission(u, state.q, state.qdot, self.dynamics.lengths, self.B) - self._pull(drag)
        if self.events.grows:
            # K (q - natural): lengths are those at first, so what has grown since is an elongation without force.
            natural = self.events.growth_at(time) * self.dynamics.lengths
            tau = tau + self.dynamics.stiffness_diagonal * self.backbone.coordinates.on_elongations(natural)
        actuation = Actuation(tau, self.actuation_stiffness, self.actuation_damping)
        later = semi_implicit_step(self.dynamics, state, actuation, dt, payload, equation=equation)
        return later, self.pid.integrate(z, self.lengths(later.q), reference.y_d, dt)

    def advance(self, now: PlantState, reference: TendonReference, dt: float, k: int | Tensor) -> PlantState:
        """`step` for the rows that are good; a row that leaves its bounds in control step k stays where it was."""
        later = self.step(now, reference, dt)
        before, after = (torch.cat(each.arm, dim=-1) for each in (now, later))
        kept, diverged_at = guard(before, after, now.diverged_at, k, self.bound)
        good = (diverged_at < 0).unsqueeze(-1)
        z, held = torch.where(good, later.z, now.z), torch.where(good, later.held, now.held)
        return PlantState(ArmState(*kept.split(self.backbone.n, dim=-1)), z, diverged_at, later.time, held)

    def settled(self, duration: float, dt: float, compile: str = "off", checkpointed: bool = False) -> PlantState:
        """The arm at rest under gravity with its tendons held at their zero lengths, its clock at zero.

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
        held = self.at_rest(straight.z)
        # Nothing happens to the arm before its clock starts.
        start = straight._replace(time=straight.time - steps * dt)
        if checkpointed:
            rest = rollout(lambda now: (step(now, held), ()), start, lambda k: (), steps, checkpointed)[0]
        else:
            rest = step(start, held, repeats=steps)
        return rest._replace(time=straight.time)

    def straight(self, batch: tuple[int, ...]) -> PlantState:
        """Straight arms without motion, tendons at their zero lengths."""
        lengths = self.dynamics.lengths
        q = torch.zeros(*batch, self.backbone.n, dtype=lengths.dtype, device=lengths.device)
        z = torch.zeros(*batch, self.B.shape[-1], dtype=lengths.dtype, device=lengths.device)
        good = torch.full(batch, -1, dtype=torch.int64, device=lengths.device)
        held = self.at_rest(z).pressure
        return PlantState(ArmState(q, q), z, good, q.new_zeros(batch), z if held is None else held)


class PlantStep(Part):
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
        return now, self.plant.at_rest(now.z)

    def forward(self, now: PlantState, reference: TendonReference) -> PlantState:
        """The arm one step later."""
        return self.plant.advance(now, reference, self.dt, 0)
