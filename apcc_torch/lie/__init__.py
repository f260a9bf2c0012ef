"""Rotations and rigid motions with derivatives that stay right at the identity."""

from __future__ import annotations

from apcc_torch.lie import se3, so3

__all__ = ["se3", "so3"]
