"""The joints between two links of a URDF, read as the format says: https://wiki.ros.org/urdf/XML.

Axes are 1 0 0 and origins zero where none is given, and `lower` and `upper` zero. A revolute or prismatic joint must
have a `<limit>` with `effort` and `velocity`. What is not read has no part in where the links are: inertias, shapes,
dynamics, calibration, safety controllers, and the joints that are not in between.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.lie import se3, so3

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
MOVES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}
"""Types of joints to what they do."""
OTHERS = ("floating", "planar")
"""Types of more coordinates than one."""
ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity", "acceleration", "deceleration", "jerk"),
}
"""What the elements that are read may have."""


class RigidJoint(NamedTuple):
    """A joint between a link and the next.

    name: Of the joint. moves: revolute, prismatic or fixed. origin: (4, 4) pose in the parent link. axis: (3,) of
    length 1, in the joint's frame. lower, upper: rad or m. velocity: rad/s or m/s, the largest.
    """

    name: str
    moves: str
    origin: Tensor
    axis: Tensor
    lower: float
    upper: float
    velocity: float


def joints_between(text: str, root_link: str | None, end_link: str) -> list[RigidJoint]:
    """The joints that lead from one link of a URDF to another, in order.

    Args:
        text: The URDF.
        root_link: Where they begin; None for the URDF's root.
        end_link: Where they end.

    Raises:
        DataError: The text is not a URDF, or a joint in between is none that is read here.
        ConfigError: There is no such link, or no chain between them.
    """
    try:
        robot = ElementTree.fromstring(text.removeprefix("\ufeff"))
    except (ElementTree.ParseError, ValueError) as error:
        raise DataError(f"the mount's text is not a URDF (a file's path must be a Path): {error}") from error
    for element in robot.iter():
        element.tag = element.tag.rpartition("}")[2]
    if robot.tag != "robot":
        raise DataError(f"the mount's text is not a URDF: it must hold a <robot>, and holds a <{robot.tag}>")
    links = _names(robot, "link")
    _names(robot, "joint")
    above = _above(robot, links)
    root = _root(links, above)
    for name in (end_link, root if root_link is None else root_link):
        if name not in links:
            raise ConfigError(f"the mount has no link {name}; it has {', '.join(links)}")
    begin, at, chain = root if root_link is None else root_link, end_link, list[ElementTree.Element]()
    while at != begin:
        if at == root:
            raise ConfigError(f"the mount's link {end_link} does not hang on link {begin}")
        chain.append(above[at][0])
        at = above[at][1]
    return [_joint(joint) for joint in reversed(chain)]


def _names(robot: ElementTree.Element, tag: str) -> list[str]:
    names = [element.get("name", "") for element in robot.findall(tag)]
    for name, count in Counter(names).items():
        if not name:
            raise DataError(f"the mount's URDF has a <{tag}> without a name")
        if count > 1:
            raise DataError(f"the mount's URDF has {count} {tag}s of the name {name}")
    return names


def _above(robot: ElementTree.Element, links: Iterable[str]) -> dict[str, tuple[ElementTree.Element, str]]:
    """Each link's joint and parent link."""
    known, above = set(links), dict[str, tuple[ElementTree.Element, str]]()
    for joint in robot.findall("joint"):
        ends = []
        for tag in ("parent", "child"):
            element = _only(joint, tag)
            name = None if element is None else element.get("link")
            if name not in known:
                raise _refused(joint, f"<{tag}> must name a link that is there, got {name}")
            ends.append(name)
        parent, child = ends
        if child in above:
            raise DataError(
                f"the mount's URDF is no tree: link {child} is the child of two joints, {above[child][0].get('name')} "
                f"and {joint.get('name')}"
            )
        above[child] = joint, parent
    return above


def _root(links: list[str], above: dict[str, tuple[ElementTree.Element, str]]) -> str:
    """The one link that has no parent, and that every other link hangs on."""
    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise DataError(f"the mount's URDF is no tree: it has several roots, {', '.join(roots)}")
    hangs = set(roots)
    for name in links:
        way = dict[str, None]()
        while name not in hangs:
            if name in way:
                raise DataError(f"the mount's URDF is no tree: link {name} hangs on itself")
            way[name] = None
            name = above[name][1]
        hangs |= way.keys()
    if not roots:
        raise DataError("the mount's text is not a URDF: it has no link")
    return roots[0]


def _joint(joint: ElementTree.Element) -> RigidJoint:
    name, kind = joint.get("name", ""), joint.get("type")
    if kind in OTHERS:
        raise _refused(joint, f"a {kind} joint is none that a mount can have: {', '.join(MOVES)}")
    if kind not in MOVES:
        raise _refused(joint, f"type must be one of {', '.join((*MOVES, *OTHERS))}, got {kind}")
    moves = MOVES[kind]
    if _only(joint, "mimic") is not None and moves != "fixed":
        raise _refused(joint, "<mimic> is none that a mount can have: each of its joints moves freely")
    return RigidJoint(name, moves, _origin(joint), _axis(joint, moves), *_limits(joint, kind))


def _origin(joint: ElementTree.Element) -> Tensor:
    """As a pose (4, 4): roll, pitch and yaw about fixed axes, then the translation."""
    given = _attributes(joint, "origin")
    roll, pitch, yaw = _vector(joint, "origin rpy", given.get("rpy", "0 0 0")).unbind()
    zero = torch.zeros_like(roll)
    turns = [torch.stack(w) for w in ((zero, zero, yaw), (zero, pitch, zero), (roll, zero, zero))]
    Z, Y, X = (so3.exp(w) for w in turns)
    return se3.pose(Z @ Y @ X, _vector(joint, "origin xyz", given.get("xyz", "0 0 0")))


def _axis(joint: ElementTree.Element, moves: str) -> Tensor:
    if _only(joint, "axis") is None or moves == "fixed":
        return torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    text = _attributes(joint, "axis").get("xyz")
    if text is None:
        raise _refused(joint, "<axis> must have xyz")
    axis = _vector(joint, "axis xyz", text)
    length = axis.norm()
    if not (0 < length < math.inf):
        raise _refused(joint, f"axis xyz must point somewhere, got {text}")
    return axis / length


def _limits(joint: ElementTree.Element, kind: str) -> tuple[float, float, float]:
    """Smallest and largest position, and largest speed."""
    given = _only(joint, "limit")
    if kind == "fixed" or (kind == "continuous" and given is None):
        return -math.inf, math.inf, math.inf
    if given is None:
        raise _refused(joint, f"a {kind} joint must have a <limit> with effort and velocity")
    values = {"lower": "0", "upper": "0"} | _attributes(joint, "limit")
    for name in ("effort", "velocity"):
        if name not in values:
            raise _refused(joint, f"<limit> must have {name}")
    lower, upper, effort, velocity = (
        _number(joint, f"limit {name}", values[name]) for name in ("lower", "upper", "effort", "velocity")
    )
    for name, value in (("effort", effort), ("velocity", velocity)):
        if value < 0:
            raise _refused(joint, f"limit {name} must not be negative, got {value:g}")
    if kind == "continuous":
        return -math.inf, math.inf, velocity
    if lower > upper:
        raise _refused(joint, f"limit lower must not be above upper, got {lower:g} and {upper:g}")
    return lower, upper, velocity


def _only(joint: ElementTree.Element, tag: str) -> ElementTree.Element | None:
    found = joint.findall(tag)
    if len(found) > 1:
        raise _refused(joint, f"there must be one <{tag}>, got {len(found)}")
    return found[0] if found else None


def _attributes(joint: ElementTree.Element, tag: str) -> dict[str, str]:
    element = _only(joint, tag)
    given = {} if element is None else element.attrib
    for name in given:
        if name not in ATTRIBUTES[tag]:
            raise _refused(joint, f"<{tag}> has {name}, which is not read: it may have {', '.join(ATTRIBUTES[tag])}")
    return given


def _vector(joint: ElementTree.Element, what: str, text: str) -> Tensor:
    words = text.split()
    if len(words) != 3:
        raise _refused(joint, f"{what} must be three numbers, got {text!r}")
    return torch.tensor([_number(joint, what, word) for word in words], dtype=torch.float64)


def _number(joint: ElementTree.Element, what: str, text: str) -> float:
    text = text.strip()
    if NUMBER.fullmatch(text) is None or not math.isfinite(float(text)):
        raise _refused(joint, f"{what} must be a finite number, got {text!r}")
    return float(text)


def _refused(joint: ElementTree.Element, why: str) -> DataError:
    return DataError(f"the mount's URDF, joint {joint.get('name')}: {why}")
