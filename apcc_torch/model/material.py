"""How stiff an arm is, from what it is made of or from how far it sags."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.statics import equilibrium

LEVEL = Placement(rotation=(0.0, pi / 2.0, 0.0))
"""A base that holds the arm out level, along x."""
PIECES = 16
"""Arcs of which a sagging arm is made."""
STIFFEST = 200.0
"""An arm so many times as stiff sags into the shape that lies next to the straight one."""
GRAVITY = Placement().acceleration


class Rigidity(NamedTuple):
    """bending: EI, N m^2. axial: EA, N."""

    bending: float
    axial: float


def of_section(young: float, radius: float, bore: float = 0.0) -> Rigidity:
    """Of a round rod, EI = E pi (r^4 - b^4) / 4 and EA = E pi (r^2 - b^2); b is the radius of its bore.

    Args:
        young: Young's modulus, Pa.
        radius: m.
        bore: m; zero: it is solid.

    Raises:
        ValueRangeError: The bore is no smaller than the rod.

    Example:
        >>> rod = of_section(young=1e6, radius=0.01)
        >>> round(rod.bending, 6), round(rod.axial, 1)
        (0.007854, 314.2)
    """
    if not 0 <= bore < radius:
        raise ValueRangeError(f"bore must be smaller than the radius of {radius:g} m, got {bore:g} m")
    return Rigidity(young * pi * (radius**4 - bore**4) / 4.0, young * pi * (radius**2 - bore**2))


def solid(bending: float, radius: float) -> Rigidity:
    """Of a solid round rod whose EI is known: EA = 4 EI / r^2."""
    return Rigidity(bending, 4.0 * bending / radius**2)


class Sagging(NamedTuple):
    """How far the tip lies below the base, m, and the shape q (n,) in which the arm rests."""

    depth: float
    q: Tensor


def sag(arm: Arm, load: float = 0.0, q: Tensor | None = None, stiffened: float = 1.0) -> Sagging | None:
    """An arm that is held out level at its base and hangs from there; None where no shape is found in which it rests.

    Args:
        arm: Its weight and rigidities are read.
        load: At its tip, kg.
        q: Shape of a similar arm to begin with; None for that of ever stiffer ones.
        stiffened: Factor on its rigidities.

    Example:
        >>> rod = sag(Arm(lengths=[0.2, 0.25], mass=0.01, bending_rigidity=0.1, axial_rigidity=1e4))
        >>> round(rod.depth, 5), round(0.01 * 9.81 * 0.45**3 / 8 / 0.1, 5)  # of a cantilever that hardly sags
        (0.01116, 0.01117)
    """
    if q is None and stiffened < STIFFEST:
        # Newton's steps from a straight arm may end in another shape than that into which it sinks.
        stiffer = sag(arm, load, stiffened=8.0 * stiffened)
        if stiffer is None:
            return None
        q = stiffer.q
    level = arm.changed(placement=LEVEL)
    axial, bending = (stiffened * stiffness for stiffness in level.section_stiffness())
    lengths = level.rest_lengths()
    dynamics = level.changed(axial_rigidity=axial * lengths, bending_rigidity=bending * lengths).dynamics(
        -(-PIECES // arm.n_sections)
    )
    rest = equilibrium(dynamics, payload=dynamics.lengths.new_tensor(load), q=q, iterations=40, tolerance=1e-8)
    if not bool(rest.converged):
        return None
    return Sagging(-float(dynamics.kinematics().tip(rest.q, dynamics.lengths)[2]), rest.q)


def from_sag(arm: Arm, measured: float, load: float = 0.0) -> Rigidity:
    """The rigidities with which an arm that is held out level sags as measured; EA is that of a solid rod.

    Args:
        arm: Its lengths, mass and tendon offset, up to which the rod is taken to reach.
        measured: How far the tip lies below the base, m.
        load: At the tip meanwhile, kg.

    Raises:
        ValueRangeError: No stiffness gives that sag.
    """
    length = float(arm.rest_lengths().sum())
    if not 0 < measured < 0.9 * length:
        raise ValueRangeError(
            f"sag must be less than nine tenths of the arm's length of {length:g} m, got {measured:g} m: "
            "an arm that hangs straight down says nothing of its stiffness"
        )
    radius = float(arm.routing().offsets.mean())
    weight = GRAVITY * float(arm.section_masses().sum())
    # A cantilever that hardly sags has this; one that sags far has less, and is approached from there.
    bending, factor = 1.2 * (weight * length**3 / 8.0 + GRAVITY * load * length**3 / 3.0) / measured, 0.6
    shape = None
    while factor < 1.0 - 1e-6:
        rigidity = solid(bending, radius)
        stiff = arm.changed(bending_rigidity=rigidity.bending, axial_rigidity=rigidity.axial)
        found = sag(stiff, load, shape)
        if found is not None and found.depth < measured:
            shape, bending = found.q, factor * bending
        else:  # too soft: back, and on in smaller steps
            bending, factor = bending / factor, factor**0.3
            bending *= factor
    return solid(bending, radius)
