"""An arm as a URDF: its links, masses and joints with limits and damping. The format has no springs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import torch
from torch import Tensor

from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.model.link_chain import Joint, Link, LinkChain, X, Y, Z, number, numbers

NOTE = (
    " URDF has no springs and no tendons: joints have limits and damping, and gravity alone would let the arm fall to "
    "its limits. The MJCF of the same arm has its stiffness and its tendons. "
)
BEND, SHORTER, LONGER = math.pi, 0.5, 2.0
"""Limits: of the bend of a section, rad, and by how much of its length an element shortens and lengthens."""
SHARE = 0.05
"""Of a link's mass, what the link between its two bends has: simulators want mass behind every joint."""
SWIFT = 10.0
"""Largest speed of a joint over its upper limit, 1/s."""


class _Move(NamedTuple):
    """One of a joint's moves: its axis, its origin on the link before it, and its limits, rad or m."""

    name: str
    axis: tuple[float, float, float]
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    lower: float
    upper: float


def urdf_text(chain: LinkChain) -> str:
    """The URDF's text.

    Links and joints have the names of the MJCF, with a link `link_K_bend` between two bends; `sensor_S` and `tip` are
    links that are fixed to others. The root is `world`, whose z axis points up. At zero all is as it is without load.

    Args:
        chain: The arm's.

    Example:
        >>> text = urdf_text(LinkChain(Arm(lengths=[0.2, 0.25]), ChainSettings(elements=2)))
        >>> text.count('type="revolute"'), text.count('type="prismatic"')
        (8, 8)
    """
    root = Element("robot", name=chain.arm.name)
    root.append(ElementTree.Comment(NOTE))
    SubElement(root, "link", name="world")
    base = quaternion_rotation(torch.tensor(chain.base, dtype=torch.float64))
    _fix(root, "mount", "world", "base", rpy=_roll_pitch_yaw(base))
    _add_link(root, "base", chain.links[0], chain.links[0].mass, chain.radius)
    before, elements = "base", len(chain.lengths) // chain.arm.n_sections
    for k, (joint, link) in enumerate(zip(chain.joints, chain.links[1:], strict=True), 1):
        here, there = (0.0, 0.0, 0.0), (0.0, 0.0, chain.links[k - 1].length)
        if joint.bends:
            between = f"link_{k}_bend"
            light = Link(link.begin, 0.0, SHARE * link.mass, 0.0, SHARE * link.across, SHARE * link.along)
            _add_link(root, between, light, light.mass, chain.radius)
            most, (x, y) = BEND / elements, joint.rest
            first = _Move("bend_x", X, there, (0.0, x, 0.0), -most, most)
            second = _Move("bend_y", Y, here, (-y, 0.0, 0.0), -most, most)
            _join(root, joint, first, before, between, chain.damping)
            _join(root, joint, second, between, f"link_{k}", chain.damping)
            _add_link(root, f"link_{k}", link, (1.0 - SHARE) * link.mass, chain.radius)
        else:
            shorter, longer = -0.5 * SHORTER * joint.length, 0.5 * LONGER * joint.length
            stretch = _Move("stretch", Z, there, here, shorter, longer)
            _join(root, joint, stretch, before, f"link_{k}", chain.damping)
            _add_link(root, f"link_{k}", link, link.mass, chain.radius)
        before = f"link_{k}"
    _add_sites(root, chain)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_link(root: Element, name: str, link: Link, mass: float, radius: float) -> None:
    """A link with the part `mass` of its own; the first moment of what it has stays that of the whole."""
    body = SubElement(root, "link", name=name)
    share = mass / link.mass
    inertial = SubElement(body, "inertial")
    SubElement(inertial, "origin", xyz=numbers((0.0, 0.0, link.centre / share)))
    SubElement(inertial, "mass", value=number(mass))
    across, along = number(share * link.across), number(share * link.along)
    SubElement(inertial, "inertia", ixx=across, iyy=across, izz=along, ixy="0", ixz="0", iyz="0")
    if not link.length:
        return
    for kind in ("visual", "collision"):
        shape = SubElement(body, kind)
        SubElement(shape, "origin", xyz=numbers((0.0, 0.0, 0.5 * link.length)))
        SubElement(SubElement(shape, "geometry"), "cylinder", radius=number(radius), length=number(link.length))


def _join(root: Element, joint: Joint, move: _Move, parent: str, child: str, damping: float) -> None:
    """A joint of the file; `damping` is over the stiffness, s."""
    kind = "revolute" if joint.bends else "prismatic"
    element = SubElement(root, "joint", name=f"{move.name}_{joint.name}", type=kind)
    SubElement(element, "parent", link=parent)
    SubElement(element, "child", link=child)
    SubElement(element, "origin", xyz=numbers(move.xyz), rpy=numbers(move.rpy))
    SubElement(element, "axis", xyz=numbers(move.axis))
    effort, velocity = joint.stiffness * move.upper, SWIFT * move.upper
    limits = {"lower": move.lower, "upper": move.upper, "effort": effort, "velocity": velocity}
    SubElement(element, "limit", {what: number(value) for what, value in limits.items()})
    SubElement(element, "dynamics", damping=number(damping * joint.stiffness), friction="0")


def _add_sites(root: Element, chain: LinkChain) -> None:
    """The arm's sensors and its tip, as links without mass."""
    for name, k, place in chain.sites():
        SubElement(root, "link", name=name)
        _fix(root, f"{name}_mount", f"link_{k}" if k else "base", name, xyz=place)


def _fix(
    root: Element,
    name: str,
    parent: str,
    child: str,
    xyz: Iterable[float] = (0.0, 0.0, 0.0),
    rpy: Iterable[float] = (0.0, 0.0, 0.0),
) -> None:
    element = SubElement(root, "joint", name=name, type="fixed")
    SubElement(element, "parent", link=parent)
    SubElement(element, "child", link=child)
    SubElement(element, "origin", xyz=numbers(xyz), rpy=numbers(rpy))


def _roll_pitch_yaw(R: Tensor) -> tuple[float, float, float]:
    """Turns about the fixed axes x, y, z, of a rotation (3, 3); at a pitch of 90 degrees, one of many."""
    r = R.tolist()
    level = math.hypot(r[0][0], r[1][0])
    pitch = math.atan2(-r[2][0], level)
    if level < 1e-9:
        return math.atan2(-r[1][2], r[1][1]), pitch, 0.0
    return math.atan2(r[2][1], r[2][2]), pitch, math.atan2(r[1][0], r[0][0])
