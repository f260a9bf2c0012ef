"""SoRoMoX's model of the same arm: six constant-strain links that bend and stretch, jitted as it recommends."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import numpy as np
import torch
from soromox.systems.components import LinkSpec
from soromox.systems.pcs.pcs import PCS
from soromox.systems.pcs.structures import PCSStructure
from soromox.systems.system_state import SystemState
from torch import Tensor

from apcc_torch.model.dynamics import SoftArmDynamics

jax.config.update("jax_enable_x64", True)

# Thin: the cross-sections' own rotational inertia, which the toolkit's point masses leave out, is negligible.
RADIUS = 1e-4
# Its backbone runs along its local x, the toolkit's along z.
AXES = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)


class Peer:
    """The same robot in SoRoMoX.

    Args:
        ours: The arm.
    """

    def __init__(self, ours: SoftArmDynamics) -> None:
        lengths, masses = ours.lengths.tolist(), ours.masses.tolist()
        stiffness = ours.stiffness_diagonal.unflatten(-1, (-1, 3))
        damping = ours.damping_diagonal.unflatten(-1, (-1, 3))
        links = [
            LinkSpec.circular(
                length=length,
                radius=RADIUS,
                density=mass / (math.pi * RADIUS**2 * length),
                reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
                stiffness=self._diagonal(k * length**2),
                damping=self._diagonal(d * length**2),
            )
            for length, mass, k, d in zip(lengths, masses, stiffness, damping, strict=True)
        ]
        selector = jax.numpy.array([False, True, True, True, False, False] * len(links))
        structure = PCSStructure(num_gauss_points=4, strain_selector=selector)
        turned = np.array(PCS.from_links(links, structure=structure, backend="jax").base_transform)[:3, :3]
        gravity = AXES @ ours.base_rotation.mT @ torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
        world = jax.numpy.array(turned @ gravity.numpy())
        self.model: Any = PCS.from_links(links, structure=structure, gravity=world, backend="jax")
        # Its coordinates per unit of the toolkit's: curvatures (-y, x) / L0 and strain dL / L0.
        block = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
        self.length = float(ours.lengths.sum())
        self.change = torch.block_diag(*(block / length for length in lengths))

    @staticmethod
    def _diagonal(k: Tensor) -> Any:
        """Torsion and shear, which the selector leaves out, are given some stiffness too."""
        bend, axial = float(k[0]), float(k[2])
        return jax.numpy.diag(jax.numpy.array([bend, bend, bend, axial, axial, axial]))

    def states(self, q: Tensor, qdot: Tensor) -> Any:
        """Its states (..., 36) of the toolkit's q and qdot."""
        return jax.numpy.array(torch.cat((q @ self.change.mT, qdot @ self.change.mT), dim=-1).numpy())

    def forward(self, q: Tensor, qdot: Tensor) -> Callable[[], Any]:
        """A jitted call of forward dynamics on these states."""
        rate = self.model.forward_dynamics
        step = jax.jit(jax.vmap(lambda y: rate(0.0, y)) if q.dim() > 1 else lambda y: rate(0.0, y))
        y = self.states(q, qdot)
        return lambda: step(y).block_until_ready()

    def acceleration(self, q: Tensor, qdot: Tensor) -> Tensor:
        """qddot in the toolkit's coordinates."""
        found = torch.from_numpy(np.array(self.forward(q, qdot)()))
        return torch.linalg.solve(self.change, found[..., q.shape[-1] :].unsqueeze(-1)).squeeze(-1)

    def tip_and_jacobian(self, q: Tensor) -> Callable[[], Any]:
        """A jitted call of the tip's pose and Jacobian at q, (R, n) or (n,)."""
        one = self.model.forward_kinematics_and_jacobian_inertialframe
        step = jax.jit(jax.vmap(lambda y: one(y, self.length)) if q.dim() > 1 else lambda y: one(y, self.length))
        y = jax.numpy.array((q @ self.change.mT).numpy())
        return lambda: jax.block_until_ready(step(y))

    def rollout(self, q: Tensor, qdot: Tensor, duration: float, dt: float) -> Callable[[], Any]:
        """A jitted open-loop rollout of one row, Tsit5 with a fixed step."""

        times = jax.numpy.linspace(0.0, duration, round(duration / 0.01) + 1)
        most = round(duration / dt) + 10

        def run(y: Any) -> Any:
            begin = SystemState(t=0.0, y=y)
            return self.model.rollout_to(
                begin, t1=duration, solver_dt=dt, save_ts=times, solver=diffrax.Tsit5(), max_steps=most
            ).y

        y = self.states(q, qdot)
        return lambda: run(y).block_until_ready()
