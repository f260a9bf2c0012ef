"""An arm as a model of MuJoCo: its links, springs, dampers, tendons with motors, and sensors, all of them named."""

from __future__ import annotations

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from apcc_torch.model.link_chain import Link, LinkChain, X, Y, Z, number, numbers

TIMESTEP = 0.002
"""s."""
MARK = 0.3
"""Size of a tendon's site, and thickness of a sensor's, over the links' radius."""
COLLAR = 1.15
"""Radius of a sensor's site over that of the links."""


def mjcf_text(chain: LinkChain) -> str:
    """The model's text.

    Element K, from 1, has joints `bend_x_K`, `bend_y_K`, `stretch_Ka` and `stretch_Kb`; a section's dx is the sum of
    its bends x, and so on. `tendon_T` pulls by the tension, N, that its motor `pull_T` is told. Sites `sensor_S` and
    `tip` have sensors of place and orientation, each tendon one of its length and one of its force.

    Args:
        chain: The arm's.

    Example:
        >>> text = mjcf_text(LinkChain(Arm(lengths=[0.2, 0.25]), ChainSettings(elements=2)))
        >>> text.count("<joint "), text.count("<spatial "), text.count("<motor ")
        (16, 6, 6)
    """
    root = Element("mujoco", model=chain.arm.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = numbers((0.0, 0.0, -chain.gravity))
    SubElement(root, "option", timestep=str(TIMESTEP), gravity=gravity, integrator="implicitfast")
    look = SubElement(SubElement(root, "default"), "default", {"class": "arm"})
    # The links touch what else is in the world, and not each other.
    SubElement(look, "geom", type="capsule", contype="0", conaffinity="1", rgba="0.55 0.7 0.9 1")
    SubElement(look, "site", size=number(MARK * chain.radius), rgba="0.2 0.2 0.2 0")
    SubElement(look, "tendon", width=number(0.1 * chain.radius), rgba="0.7 0.3 0.1 1")
    x, y, z, w = chain.base
    base = SubElement(SubElement(root, "worldbody"), "body", name="base", quat=numbers((w, x, y, z)), childclass="arm")
    bodies = [base]
    for k in range(1, len(chain.links)):
        bodies.append(_jointed(chain, k, bodies[-1]))
    for k, (body, link) in enumerate(zip(bodies, chain.links, strict=True)):
        _fill(body, link, f"link_{k}_shape", chain.radius)
    sensors = SubElement(root, "sensor")
    _add_sites(sensors, chain, bodies)
    _add_tendons(root, sensors, chain, bodies)
    for body in bodies:
        body[:] = sorted(body, key=lambda part: part.tag == "body")  # what a body has itself stands first
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _jointed(chain: LinkChain, k: int, parent: Element) -> Element:
    """Link k on the one before it."""
    joint = chain.joints[k - 1]
    body = SubElement(parent, "body", name=f"link_{k}", pos=numbers((0.0, 0.0, chain.links[k - 1].length)))
    bends = (("bend_x", "hinge", X, joint.rest[0]), ("bend_y", "hinge", Y, joint.rest[1]))
    for name, kind, axis, rest in bends if joint.bends else (("stretch", "slide", Z, 0.0),):
        spring = {"stiffness": number(joint.stiffness), "damping": number(chain.damping * joint.stiffness)}
        place = {"axis": numbers(axis), "springref": number(rest)}
        SubElement(body, "joint", {"name": f"{name}_{joint.name}", "type": kind} | place | spring)
    return body


def _fill(body: Element, link: Link, name: str, radius: float) -> None:
    """Gives a body its mass and its shape."""
    inertia = numbers((link.across, link.across, link.along))
    SubElement(body, "inertial", pos=numbers((0, 0, link.centre)), mass=number(link.mass), diaginertia=inertia)
    SubElement(body, "geom", name=name, fromto=numbers((0, 0, 0, 0, 0, link.length)), size=number(radius))


def _add_sites(sensors: Element, chain: LinkChain, bodies: list[Element]) -> None:
    """The arm's sensors and its tip."""
    size = numbers((COLLAR * chain.radius, MARK * chain.radius))
    look = {"type": "cylinder", "size": size, "rgba": "0.85 0.25 0.2 1"}
    for name, k, place in chain.sites():
        SubElement(bodies[k], "site", {"name": name, "pos": numbers(place)} | look)
        SubElement(sensors, "framepos", name=f"{name}_position", objtype="site", objname=name)
        SubElement(sensors, "framequat", name=f"{name}_orientation", objtype="site", objname=name)


def _add_tendons(root: Element, sensors: Element, chain: LinkChain, bodies: list[Element]) -> None:
    """Through sites beside the elements' ends, each with a motor that pulls."""
    tendons, actuators = SubElement(root, "tendon"), SubElement(root, "actuator")
    angles, offsets = (values.tolist() for values in (chain.routing.angles, chain.routing.offsets))
    for i, (angle, offset) in enumerate(zip(angles, offsets, strict=True), 1):
        tendon = SubElement(tendons, "spatial", {"name": f"tendon_{i}", "class": "arm"})
        for j, abscissa in enumerate(chain.tendon_places(i - 1)):
            k, along = chain.place(abscissa)
            at = (offset * math.cos(angle), offset * math.sin(angle), along)
            SubElement(bodies[k], "site", name=f"tendon_{i}_{j}", pos=numbers(at))
            SubElement(tendon, "site", site=f"tendon_{i}_{j}")
        SubElement(actuators, "motor", name=f"pull_{i}", tendon=f"tendon_{i}", gear="-1")
        SubElement(sensors, "tendonpos", name=f"tendon_{i}_length", tendon=f"tendon_{i}")
        SubElement(sensors, "actuatorfrc", name=f"pull_{i}_force", actuator=f"pull_{i}")
