"""An arm as a chain of small rigid links with springs between them: what files for rigid-body simulators hold.

Every section is divided into elements, beams in series. In its middle each bends about two axes; it stretches by half
at a quarter and by half at three quarters of its length. So it is the same from both ends, as its arc is, the middle of
its mass is where that of the arc is, and what sits at an element's end sits on a rigid link. What lies between two
joints is one link.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.lie.rotations import rotation_quaternion
from apcc_torch.model.arm import Arm
from apcc_torch.model.table import table
from apcc_torch.settings import OURS, Settings, setting

RADIUS = 0.6
"""Of the links as they are drawn and touched, over the smallest distance of a tendon from the backbone."""

X, Y, Z = (0, 1, 0), (-1, 0, 0), (0, 0, 1)
"""Axes of a bend x, which leans the arm toward x, of a bend y, and of a stretch."""


@dataclass(frozen=True, kw_only=True)
class ChainSettings(Settings):
    """How an arm is divided."""

    elements: int = setting(6, "", OURS, "of a section, each of three joints", least=1, most=200)


class Joint(NamedTuple):
    """Springs between two links.

    abscissa: m. name: The element's number from 1, and behind a stretch a or b. bends: Whether it bends about two axes,
    else it stretches. stiffness: N m/rad or N/m. rest: (x, y) bend without load, rad. length: Of the element, m.
    """

    abscissa: float
    name: str
    bends: bool
    stiffness: float
    rest: tuple[float, float]
    length: float


class Link(NamedTuple):
    """What is rigid between two joints, or before the first, or behind the last.

    begin: Abscissa, m. length: m. mass: kg. centre: Of its mass along it, m. across, along: Moments of inertia about
    the centre, kg m^2.
    """

    begin: float
    length: float
    mass: float
    centre: float
    across: float
    along: float


class LinkChain:
    """The chain of an arm.

    Args:
        arm: The arm, one row.
        settings: How it is divided.

    Attributes:
        joints: From the base to the tip.
        links: One more than joints: the first is fixed to the base.
        damping: Of a joint over its stiffness, s.
        radius: Of the links, m.
        base: (4,) the base's axes in the world, x, y, z, w; the world's z points up.
        gravity: m/s^2.
        length: Of the arm, m.

    Raises:
        ShapeError: The arm has several rows.

    Example:
        >>> chain = LinkChain(Arm(lengths=[0.2, 0.25], mass=0.4), ChainSettings(elements=4))
        >>> len(chain.links), round(sum(link.mass for link in chain.links), 9), round(chain.length, 9)
        (25, 0.4, 0.45)
    """

    def __init__(self, arm: Arm, settings: ChainSettings) -> None:
        count = settings.elements
        self.arm = arm
        self.lengths: Tensor = arm.refined(count).double()
        if self.lengths.dim() != 1:
            raise ShapeError(f"lengths must be those of one arm, got rows of shape {tuple(self.lengths.shape[:-1])}")
        self.masses: Tensor = arm.section_masses(count).double()
        self.length = float(self.lengths.sum())
        self.damping = float(arm.damping_ratio)
        self.routing = arm.routing()
        self.radius = RADIUS * float(self.routing.offsets.min())
        self.base: list[float] = rotation_quaternion(arm.base_rotation()).tolist()
        self.gravity = arm.placement.acceleration
        self.joints = self._joints(count)
        self.links = self._links()

    def _joints(self, count: int) -> list[Joint]:
        axial, bending = self.arm.section_stiffness(count)
        bend = table("rest_bend", self.arm.rest_bend, self.arm.n_sections, 2)
        zero = torch.zeros(self.arm.n_sections, 2, dtype=torch.float64)
        rests = ((zero if bend is None else bend) / count).repeat_interleave(count, dim=0).tolist()
        ends = self.lengths.cumsum(-1).tolist()
        joints = []
        springs = zip(ends, self.lengths.tolist(), axial.tolist(), bending.tolist(), rests, strict=True)
        for k, (end, length, k_axial, k_bending, (x, y)) in enumerate(springs, 1):
            straight = (0.0, 0.0)
            joints.append(Joint(end - 0.75 * length, f"{k}a", False, 2.0 * k_axial, straight, length))
            joints.append(Joint(end - 0.5 * length, f"{k}", True, k_bending, (x, y), length))
            joints.append(Joint(end - 0.25 * length, f"{k}b", False, 2.0 * k_axial, straight, length))
        return joints

    def _links(self) -> list[Link]:
        """Between two joints of an element lies a part of it, between two elements a quarter of both."""
        quarters = self.lengths.repeat_interleave(4) / 4.0
        parts = [*zip(quarters.tolist(), (self.masses.repeat_interleave(4) / 4.0).tolist(), strict=True)]
        begins = [0.0, *(joint.abscissa for joint in self.joints)]
        links, n = [], len(self.joints)
        for i, begin in enumerate(begins):
            k, place = divmod(i, 3)  # behind the last stretch of an element, or before its bend, or behind it
            first = 4 * k + place - (place == 0 and i > 0)
            last = 4 * k + place if i < n else first
            links.append(_joined(begin, parts[first : last + 1], self.radius))
        return links

    def place(self, abscissa: float) -> tuple[int, float]:
        """The link that a material abscissa lies on, m, and how far along it, m."""
        k = sum(joint.abscissa <= abscissa for joint in self.joints)
        return k, abscissa - self.links[k].begin

    def sites(self) -> list[tuple[str, int, tuple[float, float, float]]]:
        """What has a name along the arm, its sensors and its tip: name, link, place on it, m."""
        abscissae = self.arm.sensor_places().tolist()
        mounts = table("mounts", self.arm.mounts, len(abscissae), 3)
        beside = [[0.0, 0.0, 0.0]] * len(abscissae) if mounts is None else mounts.tolist()
        named = [(f"sensor_{i}", at, mount) for i, (at, mount) in enumerate(zip(abscissae, beside, strict=True), 1)]
        sites = []
        for name, abscissa, (x, y, z) in [*named, ("tip", self.length, [0.0, 0.0, 0.0])]:
            k, along = self.place(abscissa)
            sites.append((name, k, (x, y, along + z)))
        return sites

    def tendon_places(self, tendon: int) -> list[float]:
        """Abscissae of the points that a tendon runs through: its ends, and the elements' ends between them, m."""
        start, end = (float(getattr(self.routing, name)[tendon]) for name in ("starts", "anchors"))
        ends = self.lengths.cumsum(-1).tolist()
        return [start, *(x for x in ends if start + 1e-9 < x < end - 1e-9), min(end, self.length)]


def _joined(begin: float, parts: list[tuple[float, float]], radius: float) -> Link:
    """Cylinders (length m, mass kg) in line as one body."""
    mass, length, first = sum(part[1] for part in parts), 0.0, 0.0
    for long, heavy in parts:
        first += heavy * (length + 0.5 * long)
        length += long
    centre, across, before = first / mass, 0.0, 0.0
    for long, heavy in parts:
        across += heavy * (long**2 / 12.0 + radius**2 / 4.0 + (before + 0.5 * long - centre) ** 2)
        before += long
    return Link(begin, length, mass, centre, across, 0.5 * mass * radius**2)


def number(value: float) -> str:
    """A number as a file has it."""
    return f"{value:.12g}"


def numbers(values: Iterable[float]) -> str:
    """Numbers as a file has them."""
    return " ".join(number(value) for value in values)
