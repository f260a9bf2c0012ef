"""MuJoCo's cable, a flex of one dimension, and the toolkit's sections as models of one slender rod.

The rod is clamped level, and bends under its weight and a weight at its tip. A third solver has it exactly, as a
boundary value problem. Each model is taken in as few pieces as bring its tip at rest within `ACCURACY`. The cable's
edges are held at their length by constraints, so the sections are given an axial stiffness at which they hardly
stretch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.integrate import solve_bvp

from apcc_torch import PCCBackbone, SoftArmDynamics
from apcc_torch.model.loads import Loads
from apcc_torch.model.statics import equilibrium

LENGTH, MASS, BENDING, WEIGHT = 0.6, 0.3, 0.6, 0.5
"""m, kg, N m^2, and N at the tip."""
RADIUS = 0.01
"""Of the cable's cross-section, m; its modulus follows from the bending stiffness."""
STEP, DAMPING = 5e-4, 0.05
"""Of the cable on its way to rest, s."""
AXIAL = 1e5
"""Axial stiffness of the sections, N: they stretch by less than 1e-5."""
G = 9.81
ACCURACY = 0.01
"""Of the tip at rest, of the length."""
SIDEWAYS = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
"""A base whose backbone leaves along x."""
D = torch.float64


def exact_tip() -> np.ndarray:
    """Tip (x, z) of the elastica, m, by scipy's `solve_bvp`."""

    def slopes(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        beyond = MASS * G * (1.0 - s / LENGTH) + WEIGHT
        return np.stack((y[1], -beyond / BENDING * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])))

    def ends(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0.0, LENGTH, 50)
    found = solve_bvp(slopes, ends, s, np.zeros((4, s.size)), tol=1e-9)
    if not found.success:
        raise RuntimeError(f"the elastica was not found: {found.message}")
    tip: np.ndarray = found.sol(LENGTH)[2:]
    return tip


def sections(n: int) -> SoftArmDynamics:
    """The rod as n sections."""
    lengths = torch.full((n,), LENGTH / n, dtype=D)
    return SoftArmDynamics(
        lengths, MASS * lengths / LENGTH, AXIAL / lengths, BENDING / lengths, damping_ratio=0.1, base_rotation=SIDEWAYS
    )


def sections_tip(n: int) -> np.ndarray:
    """Tip (x, z) of n sections at rest, m."""
    arm = sections(n)
    q = equilibrium(arm, loads=Loads(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -WEIGHT], dtype=D))).q
    return PCCBackbone(n, SIDEWAYS).tip(q, arm.lengths)[..., [0, 2]].numpy()  # type: ignore[no-any-return]


def cable(n: int) -> Any:
    """The rod as MuJoCo's cable of n edges, clamped by a short one before them, so the clamp bends as it should."""
    edge = LENGTH / n
    points = " ".join(f"{x} 0 0" for x in (-0.02 * edge, *(k * edge for k in range(n + 1))))
    edges = " ".join(f"{k} {k + 1}" for k in range(n + 1))
    modulus = BENDING / (0.25 * math.pi * RADIUS**4)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option gravity="0 0 -{G}" timestep="{STEP}" integrator="discrete"><flag contact="disable"/></option>
      <worldbody>
        <flexcomp name="rod" type="direct" dim="1" dof="full" point="{points}" element="{edges}"
                  mass="{MASS * (n + 2) / n}" radius="{RADIUS}">
          <edge equality="true" solref="{2 * STEP} 1" solimp="0.99 0.999 0.001"/>
          <contact selfcollide="none"/>
          <elasticity young="{modulus}" poisson="0.3" section="circle" damping="{DAMPING}"/>
          <pin id="0 1"/>
        </flexcomp>
      </worldbody></mujoco>""")
    model.body_mass[model.flex_vertbodyid[-1]] *= 0.5  # the last point has half an edge
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def cable_at_rest(n: int, seconds: float = 6.0) -> tuple[Any, Any]:
    """The cable and its data once it hangs still under the weight at its tip."""
    model = cable(n)
    data = mujoco.MjData(model)
    data.xfrc_applied[model.flex_vertbodyid[-1], 2] = -WEIGHT
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
    return model, data


def fewest(tip: Callable[[int], np.ndarray], most: int = 40) -> int:
    """The fewest pieces with which a model's tip at rest is accurate."""
    exact = exact_tip()
    return next(n for n in range(1, most) if np.linalg.norm(tip(n) - exact) < ACCURACY * LENGTH)


def cable_tip(n: int) -> np.ndarray:
    """Tip (x, z) of the cable at rest, m."""
    tip: np.ndarray = cable_at_rest(n)[1].flexvert_xpos[-1][[0, 2]]
    return tip


def cable_forward(n: int) -> Callable[[], None]:
    """A call of MuJoCo's forward dynamics at rest."""
    model, data = cable_at_rest(n)
    return lambda: mujoco.mj_forward(model, data)
