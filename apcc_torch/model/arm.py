"""An arm: one description, in one file, that the model, the plant, the controller and every program read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.annotations import numbers_in
from apcc_torch.errors import ApccError, Checks, ConfigError, DataError, ValueRangeError, begun_with
from apcc_torch.files import json_in, read_text, write_atomically, yaml_in, yaml_text
from apcc_torch.lie import so3
from apcc_torch.model.arm_path import arm_path
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_tendons import Actuation, Tendons
from apcc_torch.model.backbone import HANGING, PCCBackbone
from apcc_torch.model.chambers import Chambers
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.places import check_places
from apcc_torch.model.sensor_kinds import SensorKinds, sensor_kinds
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.table import Table, table
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.modes import holds
from apcc_torch.reading import deviations, read
from apcc_torch.settings import OURS, PAPER, TURN, Setting, Settings, aligned, setting
from apcc_torch.spread import Numbers, spread

STANDING = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
BASES = {"hanging": HANGING, "standing": STANDING}

Lengths = tuple[float, ...] | Tensor
"""Numbers in metres, or a tensor (..., n) of them, one set a row."""


@dataclass(frozen=True, kw_only=True)
class Arm(Settings):
    """A soft arm of sections in series, as it is believed to be: what its file says.

    Sensors and tendon racks sit at the sections' ends unless told otherwise. Lengths and abscissae are those of the arm
    at rest, measured along it from its base.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4, tendon_offset=0.015)
        >>> arm.sensor_places()
        tensor([0.2000, 0.4500], dtype=torch.float64)
        >>> arm.routing().n_tendons
        6
    """

    name: str = setting("arm", "", OURS, "what tables and figures call it; in a file without one, the file's name")
    lengths: Lengths = setting(
        unit="m", source=PAPER, meaning="rest lengths of the sections", rows="sections", above=0, most=30
    )
    sensors: Lengths | None = setting(
        None, "m", PAPER, "abscissae of the sensors; null: the sections' ends", rows="sections", above=0
    )
    true_sensors: Lengths | None = setting(
        None, "m", OURS, "where a plant's sensors really are; null: as believed", rows="sections", above=0
    )
    sensed: tuple[str, ...] | None = setting(
        None, "", OURS, "what each sensor measures: pose, position, orientation or tilt; null: poses"
    )
    curvature_sensors: Lengths | None = setting(
        None, "m", OURS, "abscissae where curvature is measured; null: nowhere", rows="sections", above=0
    )
    mounts: Table | None = setting(
        None, "m", OURS, "from the backbone to each sensed body, (x, y, z) in the axes there; null: none"
    )
    base: str = setting(
        "hanging", "", OURS, "hanging (pi about x, the arm at z <= 0) or standing", choices=tuple(BASES)
    )
    placement: Placement = setting(factory=Placement, meaning="where the base stands in a recording's frame")
    racks: Lengths | None = setting(
        None, "m", PAPER, "abscissae of the tendon racks; null: the sections' ends", above=0
    )
    tendon_offset: Setting = setting(
        0.027, "m", PAPER, "distance of the tendons from the backbone", rows="number", above=0, most=30
    )
    tendons_per_rack: int = setting(
        3, "", PAPER, "tendons of a rack, evenly spaced around the backbone", least=1, most=100
    )
    rack_twist: float = setting(
        pi / 6.0, "rad", PAPER, "turn of each rack against the one before", least=-TURN, most=TURN
    )
    layout: str = setting(
        "coupled",
        "",
        PAPER,
        "coupled, a tendon acts from the base on; independent, from the rack before its own",
        choices=("coupled", "independent"),
    )
    tendons: Tendons = setting(factory=Tendons, meaning="the tendons one by one, where racks do not say it")
    chambers: Chambers | None = setting(
        None, "", OURS, "pressure chambers that drive the arm in place of tendons; null: none"
    )
    actuation: Actuation = setting(factory=Actuation, meaning="what drives the tendons")
    mass: Setting = setting(1.0, "kg", PAPER, "of the whole arm, spread by length", rows="number", above=0)
    masses: Lengths | None = setting(
        None, "kg", OURS, "of each section; null: mass, spread by length", rows="sections", above=0
    )
    payload: Setting | None = setting(
        None, "kg", OURS, "largest load at the tip that it is made for; null: half its mass", rows="number", least=0
    )
    axial_stiffness: Setting = setting(
        100.0, "N/m", PAPER, "of a section of the reference length", rows="number", above=0
    )
    bending_stiffness: Setting = setting(
        0.778, "N m/rad", PAPER, "of a section of the reference length", rows="number", above=0
    )
    stiffness_reference: Setting = setting(0.1, "m", PAPER, "length of the reference section", rows="number", above=0)
    stiffness_rule: str = setting(
        "series",
        "",
        OURS,
        "series: EA/l, EI/l as in beam theory; proportional: the paper's wording read literally",
        choices=("series", "proportional"),
    )
    axial_rigidity: Numbers | None = setting(
        None, "N", OURS, "EA of the sections; null: from the reference section", rows="sections", above=0
    )
    bending_rigidity: Numbers | None = setting(
        None, "N m^2", OURS, "EI of the sections; null: from the reference section", rows="sections", above=0
    )
    rest_bend: Table | None = setting(
        None, "rad", OURS, "bend (x, y) of each section without load; null: straight, as `dynamics` is"
    )
    damping_ratio: Setting = setting(0.1, "s", PAPER, "D = damping_ratio K", rows="number", least=0)

    def check(self) -> None:
        """Raises where entries differ in number, abscissae do not increase or lie beyond the arm, or none are there."""
        if not self.name.isprintable() or "/" in self.name or "${" in self.name:
            raise ConfigError(f"name must be printable, without / and ${{: runs are called by it, got {self.name!r}")
        lengths, n_b = self.rest_lengths(), self.n_sections
        if not n_b:
            raise ConfigError("lengths must name at least one section")
        end = lengths.sum(-1, keepdim=True) * (1.0 + 1e-6)
        checks = Checks()
        for name in ("sensors", "true_sensors", "curvature_sensors", "racks"):
            with checks.one():
                check_places(name, getattr(self, name), end)
        with checks.one():
            self.sensor_kinds()
            if self.true_sensors is not None and vector(self.true_sensors).shape[-1] != self.sensor_places().shape[-1]:
                raise ConfigError("true_sensors must have as many entries as sensors")
        for name in ("masses", "axial_rigidity", "bending_rigidity"):
            with checks.one():
                if getattr(self, name) is not None:
                    spread(name, getattr(self, name), n_b)
        with checks.one():
            if self.chambers is None:
                self.tendons.check_on(n_b, self._n_racked)
            else:
                self.chambers.check_on(n_b)
        with checks.one():
            self.actuation.check_on(self.n_tendons)
        offsets = {"tendon_offset": self.tendon_offset, "tendons.offsets": self.tendons.offsets}
        if self.chambers is not None:
            offsets = {"chambers.offsets": self.chambers.offsets}
        for name, offset in offsets.items():
            for number in numbers_in(offset):
                with checks.one():
                    if not holds(number < end):
                        raise ValueRangeError(
                            f"{name} must be less than the arm's length of {float(end.min()):.4g} m, got {number} m"
                        )
        for name, rows, columns in (("rest_bend", n_b, 2), ("mounts", self.sensor_places().shape[-1], 3)):
            with checks.one():
                table(name, getattr(self, name), rows, columns)
        checks.end()

    @property
    def n_sections(self) -> int:
        """Number of sections n_b."""
        return vector(self.lengths).shape[-1]

    @property
    def n_tendons(self) -> int:
        """Number of tendons, or of chambers, n_a."""
        return self.tendons.count(self._n_racked) if self.chambers is None else self.chambers.count(self.n_sections)

    @property
    def _n_racked(self) -> int:
        return self.tendons_per_rack * vector(self.lengths if self.racks is None else self.racks).shape[-1]

    def rest_lengths(self) -> Tensor:
        """(..., n_b) m, float64 unless they are a tensor."""
        return vector(self.lengths)

    def sensor_places(self) -> Tensor:
        """(..., k) abscissae at which the sensors are believed to be, m."""
        return self.rest_lengths().cumsum(-1) if self.sensors is None else vector(self.sensors)

    def true_sensor_places(self) -> Tensor:
        """(..., k) abscissae at which they are, m."""
        return self.sensor_places() if self.true_sensors is None else vector(self.true_sensors)

    def sensor_kinds(self) -> SensorKinds | None:
        """What its sensors measure; None where all measure poses."""
        return sensor_kinds(self.sensed, self.sensor_places().shape[-1])

    def placed_rotation(self) -> Tensor:
        """(3, 3) axes of the base in a recording's frame, as columns."""
        rotation = self.placement.rotation
        if rotation is None:
            return torch.tensor(BASES[self.base], dtype=torch.float64)
        return so3.exp(torch.tensor(rotation, dtype=torch.float64))

    def base_rotation(self) -> Tensor:
        """(3, 3) base of the arm in the world, whose z axis points up."""
        return self.placement.upright() @ self.placed_rotation()

    def backbone(self, kind: Callable[..., KinematicModel] = PCCBackbone, **settings: Any) -> KinematicModel:
        """A kinematic model of its sections.

        Args:
            kind: The class.
            settings: The class's own.
        """
        return kind(self.n_sections, self.base_rotation(), **settings)

    def routing(self) -> TendonRouting:
        """Its tendons; of an arm with chambers these, which push where tendons would pull."""
        if self.chambers is not None:
            return self.chambers.routing(self.rest_lengths())
        tips = self.rest_lengths().cumsum(-1)
        racks = tips if self.racks is None else vector(self.racks)
        offset = aligned(self.tendon_offset, 1)
        racked = rack_routing(racks, offset, self.tendons_per_rack, self.rack_twist, self.layout)
        return self.tendons.routing(racked, tips)

    def refined(self, factor: int) -> Tensor:
        """(..., factor n_b) lengths of the sections, each divided into `factor` equal ones, m."""
        return (self.rest_lengths() / factor).repeat_interleave(factor, dim=-1)

    def section_masses(self, factor: int = 1) -> Tensor:
        """(..., factor n_b) kg, each section divided into `factor` equal ones."""
        if self.masses is not None:
            return (vector(self.masses) / factor).repeat_interleave(factor, dim=-1)
        lengths = self.refined(factor)
        return aligned(self.mass, 1) * lengths / lengths.sum(-1, keepdim=True)

    def section_stiffness(self, factor: int = 1) -> tuple[Tensor, Tensor]:
        """Axial, N/m, and bending stiffness, N m/rad, (..., factor n_b), each section divided into `factor` ones."""
        lengths = self.refined(factor)
        reference, axial, bending = (
            aligned(value, 1) for value in (self.stiffness_reference, self.axial_stiffness, self.bending_stiffness)
        )
        axial, bending = scaled_stiffness(lengths, reference, axial, bending, self.stiffness_rule)
        n_b = self.n_sections
        if self.axial_rigidity is not None:
            axial = spread("axial_rigidity", self.axial_rigidity, n_b).repeat_interleave(factor, -1) / lengths
        if self.bending_rigidity is not None:
            bending = spread("bending_rigidity", self.bending_rigidity, n_b).repeat_interleave(factor, -1) / lengths
        return axial, bending

    def dynamics(self, factor: int = 1) -> SoftArmDynamics:
        """Its dynamics, each section divided into `factor` equal ones; sections are straight without load."""
        return SoftArmDynamics(
            self.refined(factor),
            self.section_masses(factor),
            *self.section_stiffness(factor),
            damping_ratio=self.damping_ratio,
            base_rotation=self.base_rotation(),
            gravity=self.placement.acceleration,
        )

    @staticmethod
    def load(path: str | Path) -> Arm:
        """Reads an arm's file, YAML or JSON with the fields of this class as keys, perhaps below `arm`.

        Args:
            path: The file; or the name of an arm that comes with the package in conf/arm, such as "arm_1", the paper's.

        Raises:
            DataError: The file cannot be read.
            ConfigError, ValueRangeError: There is no arm of that name, a key is unknown, or a value out of range.
        """
        path = arm_path(path)
        try:
            values = (json_in if path.suffix == ".json" else yaml_in)(read_text(path), path.name)
        except DataError as error:
            raise DataError(f"{path}: cannot be read as an arm's file: {error}") from error
        values = values.get("arm", values) if isinstance(values, dict) else None
        if not isinstance(values, dict):
            raise DataError(f"{path}: is no arm's file: it must hold keys such as lengths")
        try:
            return read({"name": Path(path).stem} | values, Arm)
        except ApccError as error:
            raise begun_with(f"{path}: ", error) from error

    def entries(self) -> dict[str, Any]:
        """What its file holds: its name and what differs from the defaults, as plain values."""
        return {"name": self.name} | deviations(self)

    def save(self, path: str | Path, comment: str = "") -> None:
        """Writes the arm as a file that `load` reads: its name and what differs from the defaults.

        Args:
            path: The file.
            comment: Lines to stand above.
        """
        head = "".join(f"# {line}\n" for line in comment.splitlines())
        write_atomically(path, head + yaml_text(self.entries()))


def vector(values: Lengths) -> Tensor:
    """Numbers as a tensor, float64 unless they are one."""
    return values if isinstance(values, Tensor) else torch.tensor(values, dtype=torch.float64)
