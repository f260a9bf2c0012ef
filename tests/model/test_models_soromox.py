"""Poses and Jacobians against SoRoMoX's piecewise constant and variable strain models, where it is installed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from kinematic_models import shapes_of
from laws import generator

jax = pytest.importorskip("jax")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)  # each function runs a few times: building it is what takes
pytest.importorskip("soromox")

from soromox.systems.components import JointSpec, LinkSpec  # noqa: E402
from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec  # noqa: E402
from soromox.systems.pcs.pcs import PCS  # noqa: E402
from soromox.systems.pcs.structures import PCSStructure  # noqa: E402

D = torch.float64
LENGTHS = torch.tensor([0.1, 0.15, 0.12], dtype=D)
X = torch.tensor([0.04, 0.24, 0.369], dtype=D)
# Its backbone runs along its local x; ours along z.
AXES = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=D)
TWISTS = torch.block_diag(AXES, AXES)


def links() -> list[Any]:
    return [
        LinkSpec.circular(
            length=length,
            radius=0.01,
            density=1000.0,
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            young_modulus=1e5,
            poisson_ratio=0.3,
        )
        for length in LENGTHS.tolist()
    ]


def numbers(value: Any) -> Tensor:
    return torch.from_numpy(np.array(value)).double()


def compare(model: KinematicModel, theirs: Any, change: Tensor, q: Tensor, atol: float) -> None:
    """Poses relative to the base and body Jacobians, in our axes and for our coordinates; change: theirs of ours."""
    q_theirs = jax.numpy.array((change @ q).numpy())
    # Arrays: a function is built once for all of them, and anew for each plain number.
    start, *places = jax.numpy.array([0.0, *X.tolist()])
    base = numbers(theirs.forward_kinematics(q_theirs, start))
    pose, body = model.pose_and_body_jacobian(q, LENGTHS, *decouple(X, LENGTHS))
    turn = torch.eye(4, dtype=D)
    turn[:3, :3] = AXES
    for i, s in enumerate(places):
        at = se3.inverse(base) @ numbers(theirs.forward_kinematics(q_theirs, s))
        torch.testing.assert_close(pose[i], turn.mT @ at @ turn, rtol=0, atol=atol)
        J = numbers(theirs.jacobian_bodyframe(q_theirs, s))
        torch.testing.assert_close(body[i], TWISTS.mT @ J @ change, rtol=0, atol=10.0 * atol)


def test_constant_strain_with_torsion_and_shear() -> None:
    structure = PCSStructure(num_gauss_points=5, strain_selector=jax.numpy.array([True] * 18))
    theirs = PCS.from_links(links(), structure=structure, backend="jax")
    model = ConstantStrainBackbone(3)
    # Ours: bends, torsion, shears and elongation over a section; theirs: strains along and about its axes per metre.
    start = model.strain_start
    change = torch.block_diag(*(TWISTS @ start / length for length in LENGTHS))
    compare(model, theirs, change, shapes_of(model, (), D, generator(0)), 1e-12)


def test_affine_curvature() -> None:
    # Legendre polynomials of order 1, 1 and 2 s - 1, about its y and z, and a constant stretch along its x.
    basis = StrainBasisSpec("legendre", ("kappa_y", "kappa_z", "sigma_x"), [0, 1, 1, 0, 0, 0])
    segments = [GVSSegment(link, JointSpec.fixed(), basis, 40) for link in links()]
    with jax.disable_jit():  # its loops run once each: building them takes longer
        theirs = GVS.from_segments(segments)
    model = AffineBackbone(3, rods=40)
    # omega about our x is (-theta_y, -sigma_y), about our y (theta_x, sigma_x): their y and z.
    block = torch.tensor(
        [[0, -1, 0, 0, 0], [0, 0, 0, -1, 0], [1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 1]], dtype=D
    )
    change = torch.block_diag(*(block / length for length in LENGTHS))
    compare(model, theirs, change, shapes_of(model, (), D, generator(1)), 1e-6)
