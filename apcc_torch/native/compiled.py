"""How a pure step is run: as it is, through torch's compiler, or as a shared library of machine code."""

from __future__ import annotations

import logging
from typing import Any, Protocol

import torch
from torch import nn

from apcc_torch.errors import CompileError, ValueRangeError
from apcc_torch.native.function import NativeFunction

log = logging.getLogger(__name__)

MODES = ("off", "inductor", "aot")


class Step(Protocol):
    """A module's `forward`; with `repeats`, so many calls in a row, each result the next one's first argument."""

    def __call__(self, *args: Any, repeats: int = 1) -> Any:
        """The result of the last call."""
        ...


class TorchStep:
    """A module run by torch: eagerly, or through `torch.compile`.

    Args:
        module: The step.
        inductor: Whether it goes through `torch.compile`, as one graph of fixed shapes.

    Example:
        >>> TorchStep(torch.nn.Tanh())(torch.tensor(1.0), repeats=3)
        tensor(0.5663)
    """

    def __init__(self, module: nn.Module, inductor: bool = False) -> None:
        self.module = torch.compile(module, fullgraph=True, dynamic=False) if inductor else module

    def __call__(self, *args: Any, repeats: int = 1) -> Any:
        """See `Step`."""
        result = self.module(*args)
        for _ in range(repeats - 1):
            first = result[0] if type(result) is tuple else result
            result = self.module(first, *args[1:])
        return result


def compiled(
    module: nn.Module, example: tuple[Any, ...], mode: str = "off", rows: int = 1, carries: bool = False
) -> Step:
    """The module as a step that is run as `mode` says.

    Where "aot" cannot be had, for want of a compiler or because the module uses an operation that it does not know, the
    log says so in one line and the step is run eagerly.

    Args:
        module: Of nested tuples of tensors; its result does not depend on branches on their values.
        example: One row of its arguments, without leading dimensions.
        mode: "off" runs it eagerly, "inductor" through torch.compile, "aot" as a library built ahead of time and kept.
        rows: How many rows it will be run on; what is built is built for these.
        carries: See `NativeFunction`.

    Raises:
        ValueRangeError: There is no such mode.

    Example:
        >>> step = compiled(torch.nn.Tanh(), (torch.tensor(0.0),), mode="off")
        >>> step(torch.tensor([0.0, 1.0]))
        tensor([0.0000, 0.7616])
    """
    if mode not in MODES:
        raise ValueRangeError(f"compile must be one of {', '.join(MODES)}, got {mode!r}")
    if mode == "aot":
        try:
            function = NativeFunction(module, example, carries)
            function.entry(function.lanes(rows))
            return function
        except CompileError as error:
            log.warning("%s is not compiled and runs eagerly: %s", type(module).__name__, error)
    return TorchStep(module, mode == "inductor")
