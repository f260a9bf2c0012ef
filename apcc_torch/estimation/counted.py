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
    check_masks(T.shape[-3], mask, angular_mask)
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


def check_masks(k: int, mask: Tensor | None, angular_mask: Tensor | None) -> dict[str, tuple[Tensor, int]]:
    """The masks that are given, for `batch_shape`.

    Raises:
        DtypeError, ShapeError: One is not bool (..., k).
    """
    given = {name: each for name, each in (("mask", mask), ("angular_mask", angular_mask)) if each is not None}
    for name, each in given.items():
        if each.dtype != torch.bool:
            raise DtypeError(f"{name} must be torch.bool, got {each.dtype}")
        if each.shape[-1:] != (k,):
            raise ShapeError(f"{name} must have shape (..., {k}), got {tuple(each.shape)}")
    return {name: (each, 1) for name, each in given.items()}
