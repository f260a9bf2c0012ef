"""The dynamic arm: section V-B's plant, under tendons whose lengths a PID loop holds, or under chambers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor
from torch.func import functional_call

from apcc_torch.control.pid import TendonReference, ramp
from apcc_torch.envs.backbone_points import BackbonePoints, ModelPoints, Positions
from apcc_torch.envs.places import middles_and_ends, places, sensors_of
from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.errors import ConfigError
from apcc_torch.linalg import solve_spd
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.integrators import ArmState
from apcc_torch.model.statics import equilibrium
from apcc_torch.part import Part, part_of
from apcc_torch.reading import read_part
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.plant_state import PlantState

PLANT = {"substeps": 1}
"""How the plant of an environment differs from a simulation's: one step of 10 ms stays within 0.1 mm of sixteen."""


LEANING_STEPS = 60
"""Steps to the rest of an arm whose base does not point up or down; gravity bends less than its tendons hold."""


@dataclass(frozen=True, kw_only=True)
class DynamicArmSettings(Settings):
    """Settings of `DynamicArm`."""

    plant: Mapping[str, Any] = setting(
        factory=dict,
        unit="",
        source=OURS,
        meaning="dynamic arms: what differs on the plant, keys of `Plant` or its `kind`",
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError where the plant has no such key, or a value is out of range."""
        super().check()
        self.plant_settings()

    def plant_settings(self) -> PlantSettings:
        """The plant's settings."""
        return cast(PlantSettings, read_part({**PLANT, **self.plant}, Plant, "plant", default=PlantSettings()))


class _Moves(Part):
    """One control period of the plant, as a module so that `functional_call` can give each row its own arm."""

    def __init__(self, plant: Plant, period: float, substeps: int) -> None:
        super().__init__()
        self.plant, self.period, self.substeps = plant, period, substeps

    def forward(self, state: PlantState, y: Tensor, y_next: Tensor) -> PlantState:
        pressed = self.plant.sets_pressure
        held = TendonReference(torch.zeros_like(y), torch.zeros_like(y), pressure=y_next)
        for i in range(1, self.substeps + 1):
            reference = held if pressed else ramp(y, y_next, i / self.substeps, self.period)
            state = self.plant.step(state, reference, self.period / self.substeps)
        return state


class _AtRest(Part):
    """Gravity's generalized force (N, n) on the plant, and its stiffness (N, n), for `functional_call` likewise."""

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        self.plant = plant

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor]:
        dynamics = self.plant.dynamics
        return dynamics.gravity(q, self.plant.payload), dynamics.stiffness_diagonal


class _Fallen(Part):
    """Where a plant without forces of its actuators comes to rest, (N, n), for `functional_call` likewise."""

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        self.plant = plant

    def forward(self) -> Tensor:
        return equilibrium(self.plant.dynamics, payload=self.plant.payload).q


class DynamicArm(Part):
    """N arms with mass; lengths, stiffness and payload may differ from row to row.

    Sensors and racks sit at the same shares of their sections on every row's own arm, so the tendons' B is one for all.

    Args:
        arm: What each of them is nominally.
        period: Control period, s.
        varied: Whether lengths or stiffness differ from row to row; the payload always may.
        like: Dtype and device.
        *settings, **changes: See `DynamicArmSettings`.

    Raises:
        ConfigError: The true arm has other numbers of sections or tendons, or other actuators.
    """

    settings_type = DynamicArmSettings

    nominal: Tensor

    def __init__(self, arm: Arm, period: float, varied: bool, like: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(DynamicArmSettings, settings, changes)
        self.hold(s)
        own = s.plant_settings()
        self.arm, self.varied, self.refine = own.true_arm(arm), varied, own.refine
        if (self.arm.chambers is None) != (arm.chambers is None):
            raise ConfigError("plant.arm.chambers must be chambers where the arm has some, and null where it has none")
        if (self.arm.n_sections, self.arm.n_tendons) != (arm.n_sections, arm.n_tendons):
            raise ConfigError("plant.arm must have as many sections and tendons as the arm")
        plant = part_of(own).on(arm, torch.zeros((), dtype=torch.float64), own).to(like)
        self.moves = _Moves(plant, period, own.substeps)
        self.leans = bool(plant.dynamics.base_rotation[2, 2].abs() < 1.0 - 1e-9)
        self.register_buffer("nominal", plant.dynamics.lengths)
        at = middles_and_ends(arm.n_sections), sensors_of(self.arm, True), self.refine
        kin = isinstance(plant.backbone, PCCBackbone)
        self.places = BackbonePoints(*at, plant.dynamics.base_rotation) if kin else ModelPoints(*at, plant.backbone)
        # Only what a tendon does on its way asks where the racks of a row's own arm are.
        lengths, routing = self.arm.rest_lengths(), self.arm.routing()
        ends = {"anchors": routing.anchors, "starts": routing.starts} if plant.transmission is not None else {}
        self.tendon_ends = {name: places(X, lengths).to(like) for name, X in ends.items()}

    def lengths(self, rows: RowParameters) -> Tensor:
        """(N, n_t) true rest lengths of the plant's sections, m."""
        return self.nominal * rows.lengths.repeat_interleave(self.refine, dim=-1)

    def initial(self, rows: RowParameters) -> PlantState:
        """Arms at rest under gravity, their tendons held at their zero lengths, chambers at their pressures of rest.

        A straight arm that hangs or stands has no force on its bends, and the one on its elongations does not depend on
        them: (K + K_P B B^T) q = -G(0) holds there, not only near it. One that leans finds its rest step by step.
        """
        plant, own = self.moves.plant, self._own(rows)
        zero = rows.payload.new_zeros(*rows.payload.shape, plant.dynamics.n)
        q = zero
        if self.leans and plant.sets_pressure:  # nothing but its own stiffness holds it: no iteration with K contracts
            q = functional_call(_Fallen(plant), own, ())
            return plant.straight(q.shape[:-1])._replace(arm=ArmState(q, zero))
        for _ in range(LEANING_STEPS if self.leans else 1):
            gravity, stiffness = functional_call(_AtRest(plant), own, (q,))
            held = torch.diag_embed(stiffness) + plant.actuation_stiffness
            q = solve_spd(held.expand(*zero.shape, -1), -gravity.unsqueeze(-1)).squeeze(-1)
        return plant.straight(q.shape[:-1])._replace(arm=ArmState(q, zero))

    def step(self, state: PlantState, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters) -> PlantState:
        """The arms after one control period in which their tendons' references go from y to y_next (N, n_a), m.

        Chambers are told y_next (N, n_a), Pa, all the while.
        """
        later: PlantState = functional_call(self.moves, self._own(rows), (state, y, y_next))
        return later

    def points(self, state: PlantState, rows: RowParameters) -> Positions:
        """Where they are."""
        positions: Positions = self.places(state.arm.q, self.lengths(rows))
        return positions

    def tendons(self, state: PlantState) -> Tensor:
        """(N, n_a) tendon length changes, m; of chambers their pressures, Pa."""
        plant = self.moves.plant
        return state.held if plant.sets_pressure else plant.lengths(state.arm.q)

    def configuration(self, state: PlantState) -> Tensor:
        """q (N, n) of the true arm."""
        return state.arm.q

    def coordinates(self, state: PlantState) -> tuple[Tensor, ...]:
        """What must stay finite and within bounds, each (N, n)."""
        return *state.arm, state.z

    def _own(self, rows: RowParameters) -> dict[str, Tensor]:
        """The plant's buffers that each row has for itself."""
        own = {"plant.payload": rows.payload}
        if self.varied:
            lengths, dynamics, arm = self.lengths(rows), self.moves.plant.dynamics, self.arm
            axial, bending = (
                self._factor(rows, arm.stiffness_rule == "series" or rigidity is not None)
                for rigidity in (arm.axial_rigidity, arm.bending_rigidity)
            )
            factors = {name: axial if name == "axial_stiffness" else bending for name in dynamics.springs}
            damping = torch.stack([factors[name] for name in dynamics.springs], dim=-1).flatten(-2)
            own |= {f"plant.dynamics.{name}": getattr(dynamics, name) * factor for name, factor in factors.items()}
            own |= {
                "plant.dynamics.lengths": lengths,
                "plant.dynamics.own_damping": dynamics.damping_diagonal * damping,
                "plant.dynamics.batch_marker": torch.zeros_like(rows.payload),
            }
            if arm.masses is None:  # else each section keeps its own
                own["plant.dynamics.masses"] = arm.mass * lengths / lengths.sum(-1, keepdim=True)
            model = lengths.unflatten(-1, (-1, self.refine)).sum(-1)
            own |= {f"plant.routing.{name}": ends.on(model) for name, ends in self.tendon_ends.items()}
        return own

    def _factor(self, rows: RowParameters, series: bool) -> Tensor:
        """(N, n_t) true stiffness over the nominal one; of springs in series, a longer section is softer."""
        stiffness = rows.stiffness.unsqueeze(-1)
        factor = stiffness / rows.lengths if series else stiffness * rows.lengths
        return factor.repeat_interleave(self.refine, dim=-1)
