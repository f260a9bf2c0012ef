"""Stiffness from a rod's section and from its sag, against beam theory and the elastica."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.integrate import quad, solve_bvp

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.material import from_sag, of_section, sag

G = 9.81


def elastica(length: float, mass: float, load: float, bending: float) -> float:
    """Sag of a heavy cantilever that does not stretch: EI theta'' = (w (L - s) + F) cos(theta), by collocation."""

    def slopes(s: np.ndarray, y: np.ndarray, stiffer: float) -> np.ndarray:
        force = G * (mass * (1.0 - s / length) + load)
        return np.vstack([y[1], force * np.cos(y[0]) / (stiffer * bending), np.sin(y[0])])

    def ends(base: np.ndarray, tip: np.ndarray) -> np.ndarray:
        return np.array([base[0], base[2], tip[1]])

    # From a stiff rod on: of a soft one there are other solutions, with loops.
    s, y = np.linspace(0.0, length, 100), np.zeros((3, 100))
    for stiffer in (256.0, 64.0, 16.0, 4.0, 1.0):
        found = solve_bvp(partial(slopes, stiffer=stiffer), ends, s, y, tol=1e-8, max_nodes=20_000)
        assert found.success
        s, y = found.x, found.y
    return -float(y[2, -1])


def test_a_tube_has_the_moments_of_its_ring() -> None:
    bore, radius = 0.004, 0.01
    second = quad(lambda r: r**2 * np.pi * r, bore, radius)[0]  # the integral of y^2 over the ring
    area = quad(lambda r: 2.0 * np.pi * r, bore, radius)[0]
    assert of_section(2e6, radius, bore) == pytest.approx((2e6 * second, 2e6 * area))
    with pytest.raises(ValueRangeError, match="bore must be smaller"):
        of_section(1e6, 0.01, 0.01)


@pytest.mark.parametrize(("load", "bending"), [(0.0, 0.02), (0.05, 0.006)])
def test_a_measured_sag_gives_the_stiffness_of_the_elastica(load: float, bending: float) -> None:
    arm = Arm(lengths=(0.2, 0.25), mass=0.04, tendon_offset=0.005)
    measured = elastica(0.45, 0.04, load, bending)
    found = from_sag(arm, measured, load)
    assert found.bending == pytest.approx(bending, rel=0.015)  # arcs, and a rod that stretches a little
    stiff = arm.changed(bending_rigidity=found.bending, axial_rigidity=found.axial)
    rest = sag(stiff, load)
    assert rest is not None and rest.depth == pytest.approx(measured, rel=1e-4)


def test_an_arm_that_hangs_straight_down_tells_nothing() -> None:
    with pytest.raises(ValueRangeError, match=r"less than nine tenths of the arm's length of 0\.2 m, got 0\.19 m"):
        from_sag(Arm(lengths=(0.2,)), 0.19)
