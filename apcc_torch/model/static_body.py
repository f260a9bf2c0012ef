"""What a resting arm pulls back with: weight and elasticity of any kinematic model, in closed form of q and lengths.

    G(q) + K q = B u + J(X)^T f

The dynamics of `dynamics.SoftArmDynamics` have these terms for constant-curvature arms of constant lengths. Here the
sections may be of any kinematic model, and the rest lengths may be estimates that change from call to call.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.abscissae import MaterialPoints, decouple, located
from apcc_torch.model.arm import Arm
from apcc_torch.model.inertia import quadrature_nodes
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.table import table
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import batch_shape, check_same, check_tensor


class StaticBody(Part):
    """Weight and elasticity of an arm; each number may be a tensor (...), one a row.

    Args:
        backbone: The model.
        density: Mass per metre of rest length, kg/m.
        axial: EA, N: 10 N for the paper's 100 N/m of a section of 0.1 m.
        bending: EI, N m^2: 0.0778 N m^2 for the paper's 0.778 N m/rad of a section of 0.1 m.
        torsion: G J, N m^2; needed where the model has torsion.
        shear: G A, N; needed where the model has shear.
        gravity: Along world -z, m/s^2.
        n_quadrature: Mass points of each section.
        per_section: Density and rigidities are tensors (..., n_b), one a section; else the arm is of one material.
        rest_bend: (..., n_b, 2) bends x and y of the sections without load, rad; None: straight.

    Raises:
        ConfigError: The model has a coordinate whose rigidity is not given.
        ValueRangeError: A number is out of range.

    Example:
        >>> body = StaticBody(PCCBackbone(2), density=1.6, axial=10.0, bending=0.08)
        >>> body.stiffness(torch.tensor([0.2, 0.25]))
        tensor([ 0.4000,  0.4000, 50.0000,  0.3200,  0.3200, 40.0000])
    """

    density: Setting
    gravity_acceleration: Setting
    nodes: Tensor
    weights: Tensor
    rest_bend: Tensor | None

    def __init__(
        self,
        backbone: KinematicModel,
        density: Setting,
        axial: Setting,
        bending: Setting,
        torsion: Setting | None = None,
        shear: Setting | None = None,
        gravity: Setting = 9.81,
        n_quadrature: int = 4,
        per_section: bool = False,
        rest_bend: Tensor | None = None,
    ) -> None:
        super().__init__()
        if n_quadrature < 2:
            raise ValueRangeError(f"n_quadrature must be at least 2, got {n_quadrature}")
        given = {"axial": axial, "bending": bending, "torsion": torsion, "shear": shear}
        for name, value in {"density": density, **given}.items():
            if value is not None:
                check_setting(name, value)
                if per_section:
                    check_tensor(name, torch.as_tensor(value), (backbone.n_sections,))
        if rest_bend is not None:
            check_tensor("rest_bend", rest_bend, (backbone.n_sections, 2))
        for coordinate in backbone.coordinates.pattern:
            if coordinate.name not in _RIGIDITY:
                raise ConfigError(f"the elasticity of {coordinate.name!r} is not known")
            if given[_RIGIDITY[coordinate.name][0]] is None:
                raise ConfigError(f"{_RIGIDITY[coordinate.name][0]} must be given: the model has {coordinate.name}")
        self.backbone = backbone
        hold_numbers(self, gravity_acceleration=check_setting("gravity", gravity, zero=True))
        hold_numbers(self, int(per_section), density=density, **given)
        hold_rows(self, rest_bend=(rest_bend, 2))
        self.n_quadrature = n_quadrature
        self.per_section = per_section
        self.derive()

    @staticmethod
    def of(arm: Arm, backbone: KinematicModel) -> StaticBody:
        """The body of an arm as its file tells it, such as an identified one: section by section.

        Args:
            arm: The arm; gravity acts along -z of its `base_rotation`'s world, as the backbone's must.
            backbone: Of its sections, with bends and elongations alone.

        Example:
            >>> arm = Arm(lengths=[0.2, 0.25], bending_rigidity=[0.08, 0.05], rest_bend=[[0.1, 0.0], [0.0, 0.0]])
            >>> StaticBody.of(arm, arm.backbone()).rest_force(torch.zeros(6).double(), arm.rest_lengths())[[0, 2, 5]]
            tensor([-0.0400, -7.6300, -2.7250], dtype=torch.float64)
        """
        lengths = arm.rest_lengths()
        axial, bending = (stiffness * lengths for stiffness in arm.section_stiffness())
        bent = None if arm.rest_bend is None else table("rest_bend", arm.rest_bend, arm.n_sections, 2)
        return StaticBody(
            backbone, arm.section_masses() / lengths, axial, bending, gravity=arm.placement.acceleration,
            per_section=True, rest_bend=bent,
        )  # fmt: skip

    def derive(self) -> None:
        """The mass points of a section, without its tip, which `quadrature_nodes` appends for a payload."""
        device = self.backbone.base_rotation.device
        for name, value in zip(("nodes", "weights"), quadrature_nodes(self.n_quadrature, torch.float64), strict=True):
            self.register_buffer(name, value[:-1].to(device), persistent=False)

    def stiffness(self, pi_hat: Tensor) -> Tensor:
        """Diagonal of K (..., n): N m/rad of angles, N/m of lengths. A section's strain energy is q K q / 2.

        Args:
            pi_hat: (..., n_b) rest lengths, m.
        """
        check_tensor("pi_hat", pi_hat, (self.backbone.n_sections,))
        coordinates = self.backbone.coordinates
        columns, section = [], 0
        for c in coordinates.pattern * (self.backbone.n // coordinates.period):
            kind, share = _RIGIDITY[c.name]
            rigidity: Any = getattr(self, kind)
            columns.append(share * (rigidity[..., section] if self.per_section else rigidity) / pi_hat[..., section])
            section += c.stretches
        return torch.stack(columns, dim=-1)

    def gravity(self, q: Tensor, pi_hat: Tensor) -> Tensor:
        """G(q) = dU/dq (..., n) of the arm's own weight, N m and N.

        Args:
            q: (..., n) rad, m.
            pi_hat: (..., n_b) rest lengths, m.
        """
        self.backbone.check(q, pi_hat)
        check_same(q=q, pi_hat=pi_hat)
        batch = batch_shape(q=(q, 1), pi_hat=(pi_hat, 1))
        n_b, n_k = self.backbone.n_sections, self.nodes.shape[0]
        q, pi_hat = q.expand(*batch, q.shape[-1]), pi_hat.expand(*batch, n_b)
        X_tilde = self.nodes.to(q).repeat(n_b).expand(*batch, n_b * n_k)
        j = torch.arange(n_b, device=q.device).unsqueeze(-1).expand(n_b, n_k).flatten().expand(*batch, n_b * n_k)
        density: Any = self.density if self.per_section else aligned(self.density, 1)
        mass = ((density * pi_hat).unsqueeze(-1) * self.weights.to(q)).flatten(-2)
        lift = self._linear(q, self.backbone.material_points(pi_hat, X_tilde, j))[..., 2, :]
        return aligned(self.gravity_acceleration, 1) * (mass.unsqueeze(-1) * lift).sum(-2)

    def rest_force(self, q: Tensor, pi_hat: Tensor) -> Tensor:
        """G(q) + K (q - q_rest) (..., n): what tendons and external forces hold at rest; arguments as `gravity`."""
        moved = q
        if self.rest_bend is not None:
            moved = q - self.backbone.coordinates.from_bends(*self.rest_bend.to(q).unbind(-1))
        return self.gravity(q, pi_hat) + self.stiffness(pi_hat) * moved

    def point_jacobians(self, q: Tensor, pi_hat: Tensor, X: Tensor) -> Tensor:
        """J (..., k, 3, n) of material points in world axes: the virtual work of a force f there is dq J^T f.

        Args:
            q: (..., n) rad, m.
            pi_hat: (..., n_b) rest lengths, m.
            X: (..., k) material abscissae, m.
        """
        self.backbone.check(q, pi_hat)
        check_tensor("X", X, (None,))
        batch = batch_shape(q=(q, 1), pi_hat=(pi_hat, 1), X=(X, 1))
        q, pi_hat, X = (v.expand(*batch, v.shape[-1]) for v in (q, pi_hat, X))
        return self._linear(q, self.backbone.material_points(pi_hat, *located(X, pi_hat)))

    def points(self, q: Tensor, pi_hat: Tensor, X: Tensor) -> Tensor:
        """Places (..., k, 3) of material points, m, world frame; arguments as `point_jacobians`."""
        return self.backbone.pose(q, pi_hat, *decouple(X, pi_hat))[..., :3, 3]

    def _linear(self, q: Tensor, points: MaterialPoints) -> Tensor:
        chain = self.backbone.chain_to(q, points)
        return chain.rotation @ chain.body_jacobian()[..., 3:, :]


# Of each coordinate its rigidity, and its factor over the section's length: a curvature that varies by
# (2 s - 1) sigma along a section stores a third of what a constant sigma does.
_RIGIDITY = {
    "bend x": ("bending", 1.0),
    "bend y": ("bending", 1.0),
    "slope x": ("bending", 1.0 / 3.0),
    "slope y": ("bending", 1.0 / 3.0),
    "torsion": ("torsion", 1.0),
    "shear x": ("shear", 1.0),
    "shear y": ("shear", 1.0),
    "elongation": ("axial", 1.0),
}
