"""M, C qdot and G against SoRoMoX's piecewise-constant-strain model, where that library is installed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.model.dynamics import SoftArmDynamics
from laws import generator, normal, rotations

jax = pytest.importorskip("jax")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)  # each function runs a few times: building it is what takes
pytest.importorskip("soromox")

from soromox.systems.components import LinkSpec  # noqa: E402
from soromox.systems.pcs.pcs import PCS  # noqa: E402
from soromox.systems.pcs.structures import PCSStructure  # noqa: E402

D = torch.float64
LENGTHS = torch.tensor([0.1, 0.15, 0.12], dtype=D)
MASSES = torch.tensor([0.2, 0.25, 0.15], dtype=D)
# So thin that the cross-sections' own rotational inertia, which the point masses leave out, is negligible.
RADIUS = 1e-6
# Its backbone runs along its local x; ours along z.
AXES = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=D)


def their_arm(base_rotation: Tensor) -> Any:
    gravity = AXES @ base_rotation.mT @ torch.tensor([0.0, 0.0, -9.81], dtype=D)
    links = [
        LinkSpec.circular(
            length=length,
            radius=RADIUS,
            density=mass / (math.pi * RADIUS**2 * length),
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            young_modulus=1e5,
            poisson_ratio=0.3,
        )
        for length, mass in zip(LENGTHS.tolist(), MASSES.tolist(), strict=True)
    ]
    # Bending about y and z, and stretch along x.
    selector = [False, True, True, True, False, False] * len(links)
    structure = PCSStructure(num_gauss_points=10, strain_selector=jax.numpy.array(selector))
    # By default its base turns its local x up.
    turned = np.array(PCS.from_links(links, structure=structure, backend="jax").base_transform)[:3, :3]
    world = jax.numpy.array(turned @ gravity.numpy())
    return PCS.from_links(links, structure=structure, gravity=world, backend="jax")


def strains() -> Tensor:
    """Their coordinates per unit of ours: curvatures (-y, x) / L0 and strain dL / L0."""
    block = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=D)
    return torch.block_diag(*(block / length for length in LENGTHS))


def test_inertia_coriolis_and_gravity() -> None:
    rng = generator(0)
    base = rotations((), D, rng)
    stiffness = torch.ones(3, dtype=D)
    ours = SoftArmDynamics(LENGTHS, MASSES, stiffness, stiffness, base_rotation=base, n_quadrature=10)
    theirs = their_arm(base)
    change = strains()
    # Their quadrature weights come in single precision.
    close = {"rtol": 1e-6, "atol": 1e-7}
    for _ in range(2):
        q = (normal((3, 3), D, rng) * torch.tensor([0.6, 0.6, 0.02], dtype=D)).flatten()
        qdot = normal((9,), D, rng)
        q_theirs, v_theirs = (jax.numpy.array((change @ value).numpy()) for value in (q, qdot))

        def ours_from(value: Any) -> Tensor:
            return torch.from_numpy(np.array(value))

        inertia = change.mT @ ours_from(theirs.inertia_matrix(q_theirs)) @ change
        bias = change.mT @ ours_from(theirs.coriolis_matrix(q_theirs, v_theirs) @ v_theirs)
        gravity = change.mT @ ours_from(theirs.gravitational_force(q_theirs))
        torch.testing.assert_close(ours.inertia(q), inertia, **close)
        torch.testing.assert_close(ours.bias(q, qdot), bias, **close)
        torch.testing.assert_close(ours.gravity(q), gravity, **close)
