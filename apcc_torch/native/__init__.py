"""Functions of tensors as machine code: traced once, written out as scalar arithmetic, built into a shared library."""

from __future__ import annotations

from apcc_torch.native.compiled import TorchStep, compiled
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.gradient import DifferentiableFunction
from apcc_torch.native.standing import StandingCall

__all__ = [
    "DifferentiableFunction",
    "NativeFunction",
    "StandingCall",
    "TorchStep",
    "compiled",
]
