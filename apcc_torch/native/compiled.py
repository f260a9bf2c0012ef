"""How a pure step is run: as it is, through torch's compiler, or as a shared library of machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import torch
from torch import nn

from apcc_torch.errors import CompileError, ValueRangeError
from apcc_torch.native.function import NativeFunction
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

T = TypeVar("T")

MODES = ("off", "inductor", "aot", "auto")


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
        self._named = type(module).__name__

    def __call__(self, *args: Any, repeats: int = 1) -> Any:
        """See `Step`.

        Raises:
            CompileError: `torch.compile` cannot compile it.
        """
        try:
            result = self.module(*args)
        except RuntimeError as error:
            if not type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
                raise
            why = str(error).strip().splitlines()[0]
            raise CompileError(f"{self._named} is not compiled by torch; compile=off runs it eagerly: {why}") from error
        for _ in range(repeats - 1):
            first = result[0] if type(result) is tuple else result
            result = self.module(first, *args[1:])
        return result


def compiled(
    module: nn.Module, example: tuple[Any, ...], mode: str = "off", rows: int = 1, carries: bool = False
) -> Step:
    """The module as a step that is run as `mode` says.

    Args:
        module: Of nested tuples of tensors; its result does not depend on branches on their values.
        example: One row of its arguments, without leading dimensions.
        mode: "off" runs it eagerly, "inductor" through torch.compile, "aot" as a library built ahead of time and kept;
            "auto" is "aot" where that can be had, else the log says in one line why not, and it is run eagerly.
        rows: How many rows it will be run on; what is built is built for these.
        carries: See `NativeFunction`.

    Raises:
        ValueRangeError: There is no such mode.
        CompileError: "aot" is asked for and cannot be had.

    Example:
        >>> step = compiled(torch.nn.Tanh(), (torch.tensor(0.0),), mode="off")
        >>> step(torch.tensor([0.0, 1.0]))
        tensor([0.0000, 0.7616])
    """

    def build() -> NativeFunction:
        function = NativeFunction(module, example, carries)
        function.program(function.lanes(rows))
        return function

    made = machine_code(build, mode, type(module).__name__)
    return TorchStep(module, mode == "inductor") if made is None else made


def machine_code(build: Callable[[], T], mode: str, what: str) -> T | None:
    """What `build` makes, where a mode asks for machine code and it can be had; None where torch is to run it.

    Args:
        build: Raises CompileError where it cannot be had.
        mode: See `compiled`.
        what: Whose it is, for people.

    Raises:
        ValueRangeError: There is no such mode.
        CompileError: "aot" is asked for and cannot be had.
    """
    if mode not in MODES:
        raise ValueRangeError(f"compile must be one of {', '.join(MODES)}, got {mode!r}")
    if mode in ("aot", "auto"):
        try:
            return build()
        except CompileError as error:
            if mode == "aot":
                raise CompileError(f"{what} is not compiled; compile=auto or off runs it eagerly: {error}") from error
            log.warning("%s is not compiled and runs eagerly: %s", what, error)
    return None
