"""Equations of motion of a Cosserat rod: bends, torsion, shears and elongation, each constant along an element.

    M(q) qddot + C(q, qdot) qdot + G(q) + D qdot + K q = tau + tau_ext

q is (bend x, bend y, torsion, shear x, shear y, elongation) per element in rad and m, piecewise constant strain
[Renda et al., 2018]. An element's mass sits half at each of its ends, as bodies that turn with the frame there:
elements are joints between rigid bodies, whose momenta add up in world axes about the world origin.

Two corrections make a cantilever end where the beam does, whatever the number of elements, as long as it bends little.
The mean of an element's curve is (p_0 + p_1) / 2 + l (t_0 - t_1) / 12, with p and t the places and tangents of its
ends, so the bodies' centres lie off the ends along the tangent; and shear is softer, see `spring`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.chain import flatten_columns
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.equation_of_motion import Energy
from apcc_torch.model.loads import Loads, Payload
from apcc_torch.model.strain_chain import StrainChain
from apcc_torch.part import hold_numbers, refuse_parameter
from apcc_torch.settings import Setting, aligned, check_setting


class _Bodies(NamedTuple):
    """The elements' ends as rigid bodies.

    chain: Their frames.
    masses: (..., n_b) kg.
    levers: (..., n_b, 3) from the ends to the bodies' centres, world axes, m.
    discs: (..., n_b) kg m^2, inertia of turning across the tangent; about it, twice that.
    """

    chain: StrainChain
    masses: Tensor
    levers: Tensor
    discs: Tensor


class RodDynamics(ArmDynamics):
    """Dynamics of a batch of Cosserat rods of round section; parameters may differ from rod to rod.

    Args:
        lengths: (..., n_b) rest lengths of the elements, m.
        masses: (..., n_b) their masses, kg.
        axial_stiffness: (..., n_b) EA / l, N/m.
        bending_stiffness: (..., n_b) EI / l, N m/rad.
        torsional_stiffness: (..., n_b) GJ / l, N m/rad.
        shear_stiffness: (..., n_b) GA / l, N/m.
        radius: Of the section, for the inertia of turning, m; a number, or a tensor (...), one a row.
        damping_ratio: D = damping_ratio K, s. Used when `damping` is None.
        damping: (..., 6 n_b) diagonal of D.
        base_rotation: (3, 3) rod base to world; None is the identity.
        gravity: Acceleration of gravity along world -z, m/s^2.

    Raises:
        ConfigError: The base rotation is batched.
        ShapeError: The parameters' shapes do not agree.
        ValueRangeError: A length, mass, stiffness or the radius is not positive, or a damping is negative.

    Example:
        >>> one = torch.tensor([0.1, 0.1]).double()
        >>> rod = RodDynamics(one, one, 50.0 * one, 0.4 * one, 0.3 * one, 900.0 * one, radius=0.02)
        >>> rod.gravity(torch.zeros(12).double())[[5, 11]]
        tensor([1.4715, 0.4905], dtype=torch.float64)
    """

    springs = (
        *("bending_stiffness", "bending_stiffness", "torsional_stiffness"),
        *("shear_stiffness", "shear_stiffness", "axial_stiffness"),
    )

    axial_stiffness: Tensor
    bending_stiffness: Tensor
    torsional_stiffness: Tensor
    shear_stiffness: Tensor
    radius: Setting
    lower: Tensor
    up: Tensor

    def __init__(
        self,
        lengths: Tensor,
        masses: Tensor,
        axial_stiffness: Tensor,
        bending_stiffness: Tensor,
        torsional_stiffness: Tensor,
        shear_stiffness: Tensor,
        radius: Setting,
        damping_ratio: float | Tensor = 0.0,
        damping: Tensor | None = None,
        base_rotation: Tensor | None = None,
        gravity: float | Tensor = 9.81,
    ) -> None:
        stiffness = {
            "axial_stiffness": axial_stiffness,
            "bending_stiffness": bending_stiffness,
            "torsional_stiffness": torsional_stiffness,
            "shear_stiffness": shear_stiffness,
        }
        super().__init__(lengths, masses, damping_ratio, damping, base_rotation, gravity, **stiffness)
        if self.base_rotation.dim() != 2:
            raise ConfigError("base_rotation of a rod must be one (3, 3) rotation, shared by all rows")
        refuse_parameter("base_rotation", self.base_rotation, "the rod's model is made of it once")
        hold_numbers(self, radius=check_setting("radius", radius))
        self.derive()

    def derive(self) -> None:
        """The model, which entries of M lie below its diagonal, and the world's z axis."""
        like = self.lengths.detach()
        self.backbone = self.kinematics()
        self.register_buffer("lower", like.new_ones(self.n, self.n).tril().bool(), persistent=False)
        self.register_buffer("up", like.new_tensor([0.0, 0.0, 1.0]), persistent=False)

    def kinematics(self) -> ConstantStrainBackbone:
        """See `ArmDynamics.kinematics`."""
        return ConstantStrainBackbone(self.n_sections, self.base_rotation)

    def spring(self, name: str) -> Tensor:
        """See `ArmDynamics.spring`; l / GA + l^3 / (12 EI) is what an element yields to shear.

        Its second part is the sag of a bend that varies along it under a shear force, which a constant bend leaves out:
        the residual bending flexibility of [MacNeal, 1978].
        """
        if name != "shear_stiffness":
            return super().spring(name)
        return 1.0 / (1.0 / self.shear_stiffness + self.lengths**2 / (12.0 * self.bending_stiffness))

    def inertia(self, q: Tensor, payload: Payload = None) -> Tensor:
        """Inertia matrix M(q) (..., n, n), symmetric positive definite; arguments as for `forward`."""
        return self._inertia(self._bodies(payload, q=q)[0])

    def _at_rest(self, q: Tensor, payload: Payload, loads: Loads) -> Tensor:
        bodies, _ = self._bodies(payload, loads, q=q)
        return self._loaded(bodies, self._weights(bodies), torch.zeros_like(bodies.chain.ends), loads)

    def _in_motion(self, q: Tensor, qdot: Tensor, payload: Payload, loads: Loads) -> tuple[Tensor, Tensor]:
        bodies, (_, rate) = self._bodies(payload, loads, q=q, qdot=qdot)
        motion = bodies.chain.drift(rate)
        spin, z, lever = motion.spin, bodies.chain.tangents, bodies.levers
        swing = torch.linalg.cross(motion.spin_rate, lever) + torch.linalg.cross(spin, torch.linalg.cross(spin, lever))
        forces = bodies.masses.unsqueeze(-1) * (motion.acceleration + swing) + self._weights(bodies)
        # Discs J = a (1 + z z^T): J alpha + omega x J omega.
        along = (z * motion.spin_rate).sum(-1, keepdim=True) * z
        gyration = (z * spin).sum(-1, keepdim=True) * torch.linalg.cross(spin, z)
        torques = bodies.discs.unsqueeze(-1) * (motion.spin_rate + along + gyration)
        return self._inertia(bodies), self._loaded(bodies, forces, torques, loads)

    def energy(self, q: Tensor, qdot: Tensor, payload: Payload = None) -> Energy:
        """See `ArmDynamics.energy`."""
        bodies, (place, rate) = self._bodies(payload, q=q, qdot=qdot)
        kinetic = 0.5 * (rate * (self._inertia(bodies) @ rate.unsqueeze(-1)).squeeze(-1)).sum(-1)
        height = (bodies.chain.ends + bodies.levers)[..., 2]
        gravity = self.gravity_acceleration * (bodies.masses * height).sum(-1)
        elastic = 0.5 * (self.stiffness_diagonal * place * place).sum(-1)
        return Energy(kinetic, gravity + elastic, gravity, elastic.expand_as(gravity))

    def _bodies(
        self, payload: Payload, loads: Loads | None = None, **coordinates: Tensor
    ) -> tuple[_Bodies, list[Tensor]]:
        """The rigid bodies at q, and the coordinates, of the leading shape of everything."""
        batch = self.checked(payload, loads, **coordinates)
        values = [value.expand(*batch, self.n) for value in coordinates.values()]
        chain = self.backbone.chain(values[0], self.lengths)
        masses = _at_ends(self.masses).expand(*batch, self.n_sections)
        # A disc of mass m and radius r: m r^2 / 4 across its axis, twice that about it.
        discs = 0.25 * aligned(self.radius, 1) ** 2 * masses
        if payload is not None:
            held = aligned(payload, 1) if isinstance(payload, Tensor) else payload
            last = torch.nn.functional.pad(torch.ones_like(masses[..., -1:]), (self.n_sections - 1, 0))
            masses = masses + held * last
        levers = (_lever(self.masses, self.lengths) / masses).unsqueeze(-1) * chain.tangents
        return _Bodies(chain, masses, levers, discs), values

    def _weights(self, bodies: _Bodies) -> Tensor:
        """Forces (..., n_b, 3) that lift the bodies, N."""
        return (aligned(self.gravity_acceleration, 1) * bodies.masses).unsqueeze(-1) * self.up

    def _inertia(self, bodies: _Bodies) -> Tensor:
        """M(q) by composite bodies: what an element moves is rigid to it."""
        chain, m = bodies.chain, bodies.masses[..., None, None]
        p, z = chain.ends.unsqueeze(-1), chain.tangents.unsqueeze(-1)
        x = p + bodies.levers.unsqueeze(-1)
        eye = torch.eye(3, dtype=p.dtype, device=p.device)
        disc = bodies.discs[..., None, None] * (eye + z @ z.mT)
        second = _beyond(m * ((x * x).sum(-2, keepdim=True) * eye - x @ x.mT) + disc)
        first, mass = _beyond(m * x), _beyond(m)
        spin, origin = chain.spin, chain.reach + torch.linalg.cross(p, chain.spin, dim=-2)
        angular = second @ spin + torch.linalg.cross(first, origin, dim=-2)
        linear = mass * origin - torch.linalg.cross(first, spin, dim=-2)
        moved, moving = (flatten_columns(torch.cat(parts, -2)) for parts in ((angular, linear), (spin, origin)))
        blocks = moved.mT @ moving
        return torch.where(self.lower, blocks, blocks.mT)

    def _loaded(self, bodies: _Bodies, forces: Tensor, torques: Tensor, loads: Loads) -> Tensor:
        """Generalized force (..., n) of forces and torques (..., n_b, 3) on the bodies, less that of external loads."""
        chain, n_b = bodies.chain, self.n_sections
        torques = torques + torch.linalg.cross(bodies.levers, forces)
        if loads.distributed is not None:
            load = loads.distributed.unsqueeze(-2).expand_as(forces)
            lever = _lever(self.lengths, self.lengths).unsqueeze(-1) * chain.tangents
            torques = torques - torch.linalg.cross(lever, load)
            forces = forces - _at_ends(self.lengths).unsqueeze(-1) * load
        for wrench in (loads.section_wrenches, _on_the_last(loads.wrench, n_b)):
            if wrench is not None:
                torques, forces = torques - wrench[..., :3], forces - wrench[..., 3:]
        p, carried = chain.ends, _beyond(forces.unsqueeze(-1))
        turning = _beyond((torques + torch.linalg.cross(p, forces)).unsqueeze(-1))
        turning = turning - torch.linalg.cross(p.unsqueeze(-1), carried, dim=-2)
        return (chain.spin.mT @ turning + chain.reach.mT @ carried).squeeze(-1).flatten(-2)


def _on_the_last(wrench: Tensor | None, n_b: int) -> Tensor | None:
    """A wrench at the tip (..., 6) as one at every element's tip (..., n_b, 6)."""
    return None if wrench is None else torch.nn.functional.pad(wrench.unsqueeze(-2), (0, 0, n_b - 1, 0))


def _next(values: Tensor) -> Tensor:
    """Of each element (..., n_b) what the next one has; zero for the last."""
    return torch.nn.functional.pad(values[..., 1:], (0, 1))


def _at_ends(values: Tensor) -> Tensor:
    """What of each element's (..., n_b) sits at its tip: half its own and half the next one's."""
    return 0.5 * (values + _next(values))


def _lever(values: Tensor, lengths: Tensor) -> Tensor:
    """First moment (..., n_b) along the tangent of what sits at each tip; see the module's head."""
    own = values * lengths / 12.0
    return _next(own) - own


def _beyond(values: Tensor) -> Tensor:
    """Sums (..., n_b, r, c) over each element and those beyond it."""
    return values.flip(-3).cumsum(-3).flip(-3)
