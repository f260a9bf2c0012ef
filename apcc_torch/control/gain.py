"""Gain matrices: one reading of what a caller gives, one check that it is positive definite."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.modes import holds
from apcc_torch.settings import About
from apcc_torch.shapes import check_finite, check_tensor
from apcc_torch.spread import Numbers, spread


def check_gain(name: str, gain: Numbers) -> None:
    """Raises where a gain has no meaning on any arm: a number not positive, a matrix that `gain_matrix` refuses."""
    rows = gain if isinstance(gain, list | tuple) and gain and isinstance(gain[0], list | tuple) else ()
    if rows:
        gain_matrix(name, gain, len(rows))
    elif isinstance(gain, Tensor) and gain.dim() > 1:
        gain_matrix(name, gain, gain.shape[-1])
    else:
        About(above=0).check(name, gain)


def gain_matrix(name: str, gain: Numbers, n: int) -> Tensor:
    """A positive definite gain as (..., n, n), float64 unless a tensor says otherwise.

    Args:
        name: The argument's name, for messages.
        gain: A number or 0-d tensor (times the identity), a diagonal of n, see `spread`, lists of n numbers,
            or (..., n, n) matrices.
        n: Size.

    Raises:
        ConfigError, ShapeError: It is none of these; a Parameter is a matrix.
        ValueRangeError: Not finite, not symmetric, or not positive definite.
    """
    if isinstance(gain, nn.Parameter) and gain.shape[-2:] != (n, n):
        raise ShapeError(f"{name} is trained as a matrix: hand in nn.Parameter(gain * torch.eye({n}))")
    if isinstance(gain, list | tuple) and gain and isinstance(gain[0], list | tuple):
        gain = torch.stack([spread(name, row, n) for row in gain])
    value = gain if isinstance(gain, Tensor) else spread(name, gain, n)
    if value.dim() == 0:
        value = value * torch.eye(n, dtype=value.dtype, device=value.device)
    elif value.dim() == 1:
        value = torch.diag_embed(check_tensor(name, value, (n,)))
    check_tensor(name, value, (n, n))
    check_finite(name, value)
    number = value.detach()
    if not holds((number - number.mT).abs().amax() <= 1e-6 * number.abs().amax()):
        raise ValueRangeError(f"{name} must be symmetric")
    lowest = torch.linalg.eigvalsh(number).amin()
    if not holds(lowest > 0):
        raise ValueRangeError(f"{name} must be positive definite, its lowest eigenvalue is {float(lowest):g}")
    return value
