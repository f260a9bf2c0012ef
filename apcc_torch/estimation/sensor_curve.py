"""A smooth curve from the arm's base through its sensors: what the sensors say of the shape between them.

The model's sections end where its rest lengths say; the curve knows nothing of them. Each piece between neighbouring
sensors is a cubic Hermite polynomial. Its end tangents are the sensors' own axes where orientations are measured;
where only positions are, they are those of the cubic spline that leaves the base along its axis and ends straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.kinematic_model import Placed
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import MANY, OURS, Settings, check_choice, resolved, setting
from apcc_torch.shapes import check_finite, check_same, check_tensor

TANGENTS = ("measured", "spline")


@dataclass(frozen=True, kw_only=True)
class SensorCurveSettings(Settings):
    """Settings of `SensorCurve`."""

    tangents: str | None = setting(
        None, "", OURS, "measured, the sensors' axes; spline, from positions alone; null: as algorithm 2 sees them"
    )
    samples: int = setting(8, "", OURS, "points of the curve between two sensors", least=1, most=MANY)

    def check(self) -> None:
        """Raises where the tangents are unknown."""
        if self.tangents is not None:
            check_choice("tangents", self.tangents, TANGENTS)


class SensorCurve(Part):
    """Points on the curve through the base and k sensors.

    Args:
        base_rotation: (3, 3) base of the arm in the world; the arm leaves the origin along its z axis.
        abscissae: (..., k) material abscissae of the sensors, m, increasing, the first beyond the base.
        *settings, **changes: See `SensorCurveSettings`; without tangents they are measured.

    Raises:
        ConfigError, ValueRangeError: A sensor lies on the base, the abscissae do not increase, or a setting is wrong.

    Example:
        >>> curve = SensorCurve(torch.eye(3), torch.tensor([0.2, 0.45]), samples=2)
        >>> T = torch.eye(4).repeat(2, 1, 1)
        >>> T[:, 2, 3] = torch.tensor([0.2, 0.45])
        >>> curve(T)[:, 2]
        tensor([0.1000, 0.2000, 0.3250, 0.4500])
    """

    settings_type = SensorCurveSettings
    tangents: str
    samples: int
    base_rotation: Tensor
    ends: Tensor
    shares: Tensor

    def __init__(self, base_rotation: Tensor, abscissae: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(SensorCurveSettings, settings, changes)
        check_tensor("base_rotation", base_rotation, (3, 3))
        check_finite("abscissae", check_tensor("abscissae", abscissae, (None,)))
        if abscissae.shape[-1] == 0 or not holds(torch.nn.functional.pad(abscissae, (1, 0)).diff() > 0):
            raise ValueRangeError(f"abscissae must increase from beyond the base, got {abscissae.tolist()}")
        hold_rows(self, base_rotation=(base_rotation, 2), ends=(abscissae, 1))
        self.hold(s.changed(tangents=s.tangents or "measured"))

    def derive(self) -> None:
        """Where on each piece its points lie."""
        like, n = self.ends, self.samples
        share = torch.arange(1, n + 1, dtype=like.dtype, device=like.device) / n
        self.register_buffer("shares", share, persistent=False)

    @property
    def abscissae(self) -> Tensor:
        """(..., k samples) material abscissae of the curve's points, m."""
        ends = torch.nn.functional.pad(self.ends, (1, 0))
        return (ends[..., :-1, None] + ends.diff().unsqueeze(-1) * self.shares).flatten(-2)

    def forward(self, T: Tensor) -> Tensor:
        """Points (..., k samples, 3) m, world frame, at the material abscissae `abscissae` of an evenly stretched arm.

        Args:
            T: (..., k, 4, 4) sensor poses, world frame, m.

        Raises:
            ShapeError, DtypeError: T does not fit.
        """
        check_tensor("T", T, (self.ends.shape[-1], 4, 4))
        check_same(T=T, abscissae=self.ends.to(T.dtype))
        base = torch.zeros_like(T[..., :1, :3, 3])
        axis = self.base_rotation[:, 2].to(T).expand_as(base)
        position = torch.cat((base, T[..., :3, 3]), dim=-2)
        start, end = position[..., :-1, :], position[..., 1:, :]
        chord = (end - start).norm(dim=-1, keepdim=True)
        tangent = torch.cat((axis, T[..., :3, 2]), dim=-2) if self.tangents == "measured" else _spline(axis, position)
        # The length of the arc with this chord between these tangents: c h / sin h with h half their angle.
        cosine = (tangent[..., :-1, :] * tangent[..., 1:, :]).sum(-1, keepdim=True)
        # As near to one as the dtype tells from one: h = 0 has no quotient.
        limit = 1.0 - max(1e-9, torch.finfo(cosine.dtype).eps)
        half = 0.5 * torch.acos(cosine.clamp(-limit, limit))
        speed = chord * half / torch.sin(half)
        u = self.shares.to(T).unsqueeze(-1)
        u2, u3 = u * u, u * u * u
        start, end, leave, arrive = (
            value.unsqueeze(-2) for value in (start, end, speed * tangent[..., :-1, :], speed * tangent[..., 1:, :])
        )
        points = (2 * u3 - 3 * u2 + 1) * start + (u3 - 2 * u2 + u) * leave
        return (points + (3 * u2 - 2 * u3) * end + (u3 - u2) * arrive).flatten(-3, -2)

    def across(self, chain: Placed, T: Tensor) -> Tensor:
        """Distances (..., k samples, 2) m from a model to the curve, across its backbone.

        How far along the backbone a point lies is a matter of stretch, not of shape.

        Args:
            chain: The model's frames at `abscissae`.
            T: (..., k, 4, 4) sensor poses, world frame, m.
        """
        # In a point's own axes the backbone runs along z.
        return (chain.rotation.mT @ (self(T) - chain.tip).unsqueeze(-1))[..., :2, 0]


def _spline(axis: Tensor, position: Tensor) -> Tensor:
    """(..., m, 3) unit tangents of the cubic spline through m points that leaves along `axis` and ends uncurved."""
    m = position.shape[-2]
    step = position.diff(dim=-2)
    inverse = step.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(step.dtype).tiny).reciprocal()
    slope = step * inverse
    zero = torch.zeros_like(inverse[..., :1, :])
    before, after = torch.cat((zero, inverse), dim=-2), torch.cat((inverse, zero), dim=-2)
    # Continuous second derivatives inside, none at the end: a tridiagonal system for the tangents.
    matrix = torch.diag_embed(2.0 * (before + after).squeeze(-1))
    matrix = matrix + torch.diag_embed(inverse.squeeze(-1), 1) + torch.diag_embed(inverse.squeeze(-1), -1)
    pull = slope * inverse
    none = torch.zeros_like(pull[..., :1, :])
    right = 3.0 * (torch.cat((none, pull), dim=-2) + torch.cat((pull, none), dim=-2))
    first = torch.zeros(m, dtype=torch.bool, device=position.device)
    first[0] = True
    identity = torch.eye(m, dtype=position.dtype, device=position.device)
    matrix = torch.where(first.unsqueeze(-1), identity, matrix)
    right = torch.where(first.unsqueeze(-1), axis, right)
    tangent = torch.linalg.solve_ex(matrix, right).result  # two sensors in one place: no error, no finite row
    return tangent / tangent.norm(dim=-1, keepdim=True)
