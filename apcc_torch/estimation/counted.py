"""Which sensors of a reading count, and which of their orientations."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError
from apcc_torch.lie.rotations import is_rotation
from apcc_torch.model.sensor_kinds import SensorKinds


def counted(
    T: Tensor, kinds: SensorKinds | None, mask: Tensor | None = None, angular_mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Positions and orientations that count: two bool (..., k).

    What is not finite does not count, and none of a row does in which one that does is no pose: what else such a source
    says is as wrong.

    Args:
        T: (..., k, 4, 4) as measured.
        kinds: What the sensors measure; None for poses. Nothing else is looked at.
        mask, angular_mask: (..., k) bool, sensors and orientations to leave out; None for none.
    """
    for name, given in {"mask": mask, "angular_mask": angular_mask}.items():
        if given is not None:
            check_mask(name, given, T.shape[-3])
    T = T if kinds is None else kinds.filled(T)
    usable = torch.isfinite(T).flatten(-2).all(-1)
    if mask is not None:
        usable = usable & mask
    oriented = usable
    if angular_mask is not None:
        oriented = usable & angular_mask
    last = (T[..., 3, :3] == 0.0).all(-1) & (T[..., 3, 3] == 1.0)
    wrong = (usable & ~last) | (oriented & ~is_rotation(T[..., :3, :3]))
    right = ~wrong.any(-1, keepdim=True)
    usable, oriented = usable & right, oriented & right
    if kinds is not None:
        usable, oriented = usable & kinds.placed.to(T.device), oriented & kinds.turned.to(T.device)
    return usable, oriented


def check_mask(name: str, mask: Tensor, k: int) -> Tensor:
    """Returns `mask` if it is bool (..., k); raises DtypeError or ShapeError where it is not."""
    if mask.dtype != torch.bool:
        raise DtypeError(f"{name} must be torch.bool, got {mask.dtype}")
    if mask.shape[-1:] != (k,):
        raise ShapeError(f"{name} must have shape (..., {k}), got {tuple(mask.shape)}")
    return mask
