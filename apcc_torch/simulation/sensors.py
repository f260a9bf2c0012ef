"""Sensors as they are: noise, delay and dropout, with the randomness passed in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import se3
from apcc_torch.model.sensor_kinds import SensorKinds
from apcc_torch.part import Part
from apcc_torch.settings import MANY, OURS, Setting, Settings, aligned, is_on, resolved, setting
from apcc_torch.shapes import check_tensor
from apcc_torch.simulation.curvature_sensors import CurvatureSensors, CurvatureSensorsSettings, CurvatureState
from apcc_torch.simulation.inertial_units import InertialState, InertialUnits, InertialUnitsSettings


class SensorState(NamedTuple):
    """What sensors remember.

    queue: (..., delay + 1, k, 4, 4) poses on their way, the newest first. inertial, curvature: Of inertial units and of
    gratings; None without any.
    """

    queue: Tensor
    inertial: InertialState | None = None
    curvature: CurvatureState | None = None


class Draws(NamedTuple):
    """The chance in a reading; None where not used.

    noise: (..., k, 6) standard normal, of the poses. chance: (..., k) uniform. tendons: (..., n_a), inertial:
    (..., p, 4) and curvature: (..., n_c, 2) standard normal.
    """

    noise: Tensor | None
    chance: Tensor | None
    tendons: Tensor | None = None
    inertial: Tensor | None = None
    curvature: Tensor | None = None


class Seen(NamedTuple):
    """One reading.

    T: (..., k, 4, 4) measured poses, NaN for what a sensor does not measure. mask: (..., k) bool, False where a sensor
    dropped out. curvature: (..., n_c, 2) 1/m; None without gratings.
    """

    T: Tensor
    mask: Tensor
    curvature: Tensor | None


@dataclass(frozen=True, kw_only=True)
class PoseSensorsSettings(Settings):
    """Settings of `PoseSensors`."""

    position_noise: Setting = setting(
        0.0, "m", OURS, "standard deviation of each coordinate", rows="number", least=0, apart=True
    )
    angular_noise: Setting = setting(
        0.0, "rad", OURS, "standard deviation of each rotation-vector component", rows="number", least=0, apart=True
    )
    delay: int = setting(0, "", OURS, "control periods by which a reading is late", least=0, most=MANY)
    dropout: Setting = setting(
        0.0, "", OURS, "chance that a sensor is missing in a reading", rows="number", least=0, below=1, apart=True
    )
    tendon_noise: Setting = setting(
        0.0, "m", OURS, "standard deviation of each tendon's measured length", rows="number", least=0, apart=True
    )
    tendon_stretch: Setting = setting(
        0.0,
        "m/N",
        OURS,
        "of each tendon between its motor, which measures it, and the arm",
        rows="number",
        least=0,
        apart=True,
    )
    inertial: InertialUnitsSettings = setting(
        factory=InertialUnitsSettings, meaning="of the sensors that measure an orientation or a tilt"
    )
    curvature: CurvatureSensorsSettings = setting(
        factory=CurvatureSensorsSettings, meaning="of those that measure curvature"
    )


class PoseSensors(Part):
    """Turns true poses into measured ones, and the tendons' true lengths into those that their motors measure.

    What a sensor does not measure is NaN. The noise of poses and positions is that of the settings; an inertial unit
    has its own, and so has curvature.

    Args:
        *settings, **changes: See `PoseSensorsSettings`; numbers but the delay may be tensors (...), one a row.
        shared: Number of leading dimensions over which the draws are the same, as in runs of one seed side by side.
        kinds: What the sensors measure; None for poses.
        period: s between two readings, in which headings drift.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> sensors = PoseSensors(position_noise=2e-4)
        >>> T = torch.eye(4).repeat(3, 1, 1)
        >>> state, seen, mask = sensors(sensors.initial_state(T), T, torch.Generator().manual_seed(0))
        >>> seen.shape, mask.tolist()
        (torch.Size([3, 4, 4]), [True, True, True])
    """

    settings_type = PoseSensorsSettings
    position_noise: Setting
    angular_noise: Setting
    delay: int
    dropout: Setting
    tendon_noise: Setting
    tendon_stretch: Setting

    def __init__(
        self,
        *settings: Any,
        shared: int = 0,
        kinds: SensorKinds | None = None,
        period: float = 0.02,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(PoseSensorsSettings, settings, changes)
        self.shared = shared
        self.kinds = kinds
        self.units = [] if kinds is None else kinds.inertial
        self.inertial = InertialUnits(s.inertial, period=period)
        self.curvature = CurvatureSensors(s.curvature)
        self.hold(s)

    @property
    def noisy(self) -> bool:
        """Whether anything is added to a reading."""
        return is_on(self.position_noise) or is_on(self.angular_noise)

    def initial_state(
        self, T: Tensor, curvature: Tensor | None = None, generator: torch.Generator | None = None
    ) -> SensorState:
        """State of sensors that have long seen an arm.

        Args:
            T: (..., k, 4, 4) poses.
            curvature: (..., n_c, 2) 1/m; None where it is not measured.
            generator: Of what is drawn once; None for torch's global one.
        """
        check_tensor("T", T, (None, 4, 4))
        queue = T.unsqueeze(-4).expand(*T.shape[:-3], self.delay + 1, *T.shape[-3:])
        inertial = bent = None
        if self.units:
            inertial = self.inertial.initial_state(T[..., self.units, 0, 0], generator, self.shared)
        if curvature is not None:
            bent = self.curvature.initial_state(curvature, self.delay, generator, self.shared)
        return SensorState(queue, inertial, bent)

    def draw(
        self, T: Tensor, generator: torch.Generator | None = None, n_tendons: int = 0, n_curvature: int = 0
    ) -> Draws:
        """The chance in one reading of poses with the shape of T (..., k, 4, 4).

        Args:
            T: Read for its shape and type alone.
            generator: Where it comes from; None for torch's global one.
            n_tendons: Tendons that are measured too.
            n_curvature: Places where curvature is.
        """
        drawn = T.shape[self.shared : -2]

        def normal(*shape: int) -> Tensor:
            return torch.randn(*drawn[:-1], *shape, dtype=T.dtype, device=T.device, generator=generator)

        noise = chance = tendons = inertial = curvature = None
        if self.noisy:
            noise = normal(drawn[-1], 6)
        if is_on(self.dropout):
            chance = torch.rand(drawn, dtype=T.dtype, device=T.device, generator=generator)
        if n_tendons and is_on(self.tendon_noise):
            tendons = normal(n_tendons)
        if self.units and self.inertial.noisy:
            inertial = normal(len(self.units), 4)
        if n_curvature and self.curvature.noisy:
            curvature = normal(n_curvature, 2)
        return Draws(noise, chance, tendons, inertial, curvature)

    @property
    def stretches(self) -> bool:
        """Whether what a motor measures depends on its tendon's force."""
        return is_on(self.tendon_stretch)

    def measured_tendons(self, y: Tensor, u: Tensor | None, draws: Draws) -> Tensor:
        """Length changes (..., n_a) m as the motors measure them: a tendon that is pulled is longer than they say.

        Args:
            y: (..., n_a) true ones along the arm, m.
            u: (..., n_a) the tendons' forces, N, tension is -u; None where nothing `stretches`.
            draws: From `draw`.
        """
        if self.stretches and u is not None:
            y = y + aligned(self.tendon_stretch, 1) * u
        return y if draws.tendons is None else y + aligned(self.tendon_noise, 1) * draws.tendons

    def forward(
        self, state: SensorState, T: Tensor, generator: torch.Generator | None = None
    ) -> tuple[SensorState, Tensor, Tensor]:
        """One reading.

        Args:
            state: From `initial_state` or the last reading.
            T: (..., k, 4, 4) true poses now.
            generator: Source of the noise; None for torch's global one.

        Returns:
            Next state, measured poses (..., k, 4, 4), and mask (..., k) bool, False where a sensor dropped out.
        """
        later, seen = self.sense(state, T, None, self.draw(T, generator))
        return later, seen.T, seen.mask

    def sense(self, state: SensorState, T: Tensor, curvature: Tensor | None, draws: Draws) -> tuple[SensorState, Seen]:
        """`forward` with its chance drawn before, and of curvature (..., n_c, 2), 1/m, where that is measured."""
        check_tensor("T", T, (None, 4, 4))
        queue = torch.cat((T.unsqueeze(-4), state.queue[..., :-1, :, :, :]), dim=-4)
        seen = true = queue[..., -1, :, :, :]
        if draws.noise is not None:
            angle = draws.noise[..., :3] * aligned(self.angular_noise, 2)
            turn = se3.exp(torch.cat((angle, torch.zeros_like(angle)), dim=-1))
            place = seen[..., :3, 3] + aligned(self.position_noise, 2) * draws.noise[..., 3:]
            seen = se3.pose(seen[..., :3, :3], place) @ turn
        mask = torch.ones(T.shape[:-2], dtype=torch.bool, device=T.device)
        if draws.chance is not None:
            mask = (draws.chance >= aligned(self.dropout, 1)).expand(T.shape[:-2])
        inertial, bent, shown = state.inertial, state.curvature, None
        if inertial is not None:
            inertial, R = self.inertial(inertial, true[..., self.units, :3, :3], draws.inertial)
            seen = seen.index_copy(seen.dim() - 3, torch.tensor(self.units, device=T.device), _turned(R))
        if self.kinds is not None:
            seen = self.kinds.blanked(seen)
        if curvature is not None and bent is not None:
            bent, shown = self.curvature(bent, curvature, draws.curvature)
        return SensorState(queue, inertial, bent), Seen(seen, mask, shown)


def _turned(R: Tensor) -> Tensor:
    """Poses (..., 4, 4) with rotations (..., 3, 3), in the origin."""
    return se3.pose(R, torch.zeros_like(R[..., 0]))
