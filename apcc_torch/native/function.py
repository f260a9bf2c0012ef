"""A module compiled to machine code, called like the module."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from apcc_torch.errors import CompileError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.native.build import compiler, widest_vector
from apcc_torch.native.fingerprint import fingerprint
from apcc_torch.native.kept_program import Program, kept_program
from apcc_torch.native.source import Source, program
from apcc_torch.native.structure import any_double, described, flattened, rebuilt
from apcc_torch.native.trace import Leaf, Trace, traced
from apcc_torch.part import row_tensors


class _Rows(nn.Module):
    """A module as a function of its arguments and of the tensors that it holds for every row."""

    def __init__(self, module: nn.Module, names: list[str]) -> None:
        super().__init__()
        self.module = module
        self.names = names

    def forward(self, *args: Any) -> Any:
        split = len(args) - len(self.names)
        return functional_call(self.module, dict(zip(self.names, args[split:], strict=True)), args[:split])


def one_row(module: nn.Module) -> tuple[nn.Module, tuple[Tensor, ...]]:
    """The module as a function of one row, and the further arguments that it then has, of the first row."""
    rows = row_tensors(module)
    if not rows:
        return module, ()
    extra = tuple(tensor[(0,) * (tensor.dim() - trailing)].clone() for tensor, trailing in rows.values())
    return _Rows(module, list(rows)), extra


class _Ready:
    """Machine code with its arguments, and all that must be alive when it runs."""

    __slots__ = ("_arguments", "_kept", "_run")

    def __init__(self, run: Any, arguments: tuple[Any, ...], kept: list[Tensor]) -> None:
        self._run, self._arguments, self._kept = run, arguments, kept

    def __call__(self) -> None:
        self._run(*self._arguments)


class NativeFunction:
    """A module's `forward` as machine code for any number of rows.

    It is traced at one row of arguments, written out in scalar arithmetic and built into a shared library, which is
    kept and found again by the module's settings, the code and the machine. What the module holds is taken as it is
    now, but for the tensors that it holds for every row (`settings.row_tensors`), which are read at each call.
    Arguments may carry leading dimensions, which broadcast; rows are worked on side by side in the lanes of the
    machine's vectors, and over `threads` threads.

    Not differentiable, on the CPU only, and without the argument checks of the module itself, which the first, eager
    call at the example has made. A product with a constant zero is zero, even of what is not finite.

    Args:
        module: Of (nested tuples of) tensors, without branches on their values.
        example: One row of arguments, without leading dimensions.
        carries: The first result (or the only one) has the form of the first argument, and is its next value: calls may
            then repeat the function.
        threads: Over which large batches are spread; None for torch's number.

    Raises:
        CompileError: It cannot be compiled, or there is no compiler.

    Example:
        >>> pid = TendonPID(K_I=0.0, K_D=0.0)
        >>> row = torch.zeros(3).double()
        >>> fast = NativeFunction(pid, (row, row, row, row, row))
        >>> still, y_d = torch.zeros(1000, 3).double(), torch.full((1000, 3), 0.001).double()
        >>> fast(still, still, still, y_d, still)[0]
        tensor([0.7500, 0.7500, 0.7500], dtype=torch.float64)
    """

    def __init__(
        self, module: nn.Module, example: tuple[Any, ...], carries: bool = False, threads: int | None = None
    ) -> None:
        self.module = module
        self._named = type(module).__name__
        self.threads = threads
        self._rows = [tensor for tensor, _ in row_tensors(module).values()]
        with torch.inference_mode():
            self.traced, extra = one_row(module)
            self._like = self.traced(*example, *extra)
        self.example = (*example, *extra)
        given, returned = flattened(self.example), flattened(self._like)
        self._inputs = [Leaf(tuple(t.shape), t.dtype) for t in given]
        self._outputs = [Leaf(tuple(t.shape), t.dtype) for t in returned]
        for tensor in given:
            if tensor.device.type != "cpu":
                raise CompileError(f"only the CPU's code is compiled, the example is on {tensor.device}")
        self._carried = self._pairs(example[0]) if carries else []
        held = [t for t in (*module.buffers(), *module.parameters()) if t.is_floating_point()]
        # Where anything is of double precision everything is, inside: what torch would round in between is not.
        self._dtype = torch.float64 if any_double(given + returned + held) else torch.float32
        # Here, not at each call: it looks for the compiler.
        self._widest = widest_vector(compiler()) // self._dtype.itemsize
        self._programs: dict[int, Program] = {}
        self._trace: Trace | None = None

    def _pairs(self, given: Any) -> list[tuple[int, int]]:
        first = self._like[0] if type(self._like) is tuple else self._like
        now, later = described(given), described(first)
        if now != later:
            raise CompileError(f"what is carried must come back as it went in: {now} became {later}")
        return [(k, k) for k in range(len(flattened(first)))]

    def program(self, lanes: int) -> Program:
        """The compiled code for so many rows at once, built where it is not there yet, or damaged.

        Raises:
            CompileError: It cannot be built, kept or loaded.
        """
        if lanes not in self._programs:
            form = described(self.example), str(self._carried), f"{lanes} lanes of {self._dtype}"
            name = fingerprint(self.module, *form)
            self._programs[lanes] = kept_program(name, self._dtype, lambda: self._source(lanes), self._named)
        return self._programs[lanes]

    def _source(self, lanes: int) -> Source:
        if self._trace is None:
            with torch.inference_mode(False):
                self._trace = traced(self.traced, self.example)
        return program(self._trace, lanes, self._dtype, self._carried, os.cpu_count() or 1)

    def lanes(self, rows: int) -> int:
        """How many rows are worked on at once in a batch of `rows`."""
        return 1 if rows == 1 else self._widest

    def __call__(self, *args: Any, repeats: int = 1) -> Any:
        """The module's result for these arguments; with `repeats`, the last of so many calls that each carry on.

        Raises:
            ShapeError, DtypeError: The arguments are not the example's with leading dimensions.
            ValueRangeError: `repeats` is not positive, or an argument asks for a gradient.
        """
        given = [*flattened(args), *self._rows]
        if len(given) != len(self._inputs):
            wanted = len(self._inputs) - len(self._rows)
            raise ShapeError(f"the compiled function takes {wanted} tensors, got {len(given) - len(self._rows)}")
        if repeats < 1 or (repeats > 1 and not self._carried):
            raise ValueRangeError(f"repeats must be 1, or more where the function carries its result; got {repeats}")
        batch = self._batch(given)
        rows = batch.numel()
        if rows == 0:
            outputs = [torch.empty((*batch, *leaf.shape), dtype=leaf.dtype) for leaf in self._outputs]
            return rebuilt(self._like, iter(outputs))
        outputs = [torch.empty((*batch, *leaf.shape), dtype=leaf.dtype) for leaf in self._outputs]
        self._ready(given, outputs, batch, repeats)()
        return rebuilt(self._like, iter(outputs))

    def blank(self, given: list[Tensor]) -> Any:
        """What a call with these flattened arguments returns, of zeros."""
        batch = self._batch([*given, *self._rows])
        return rebuilt(self._like, (torch.zeros((*batch, *leaf.shape), dtype=leaf.dtype) for leaf in self._outputs))

    def bound(self, given: list[Tensor], outputs: list[Tensor]) -> Callable[[], None]:
        """A call on tensors that stay where they are, which may be made again and again.

        Args:
            given: The flattened arguments, contiguous.
            outputs: The flattened results, contiguous, of the arguments' leading shape; each call overwrites them.

        Raises:
            ShapeError, DtypeError: They are not the example's with leading dimensions.
        """
        given = [*given, *self._rows]
        return self._ready(given, outputs, self._batch(given))

    def _ready(self, given: list[Tensor], outputs: list[Tensor], batch: torch.Size, repeats: int = 1) -> _Ready:
        """A call that needs nothing more."""
        pointers = (ctypes.c_void_p * len(given))()
        strides = (ctypes.c_long * len(given))()
        kept = []  # alive as long as the call
        for k, (tensor, leaf) in enumerate(zip(given, self._inputs, strict=True)):
            if tensor.shape != leaf.shape:
                if tensor.shape[: tensor.dim() - len(leaf.shape)] != batch:
                    tensor = tensor.expand(*batch, *leaf.shape)
                strides[k] = tensor[(0,) * len(batch)].numel()
            tensor = tensor.contiguous()
            kept.append(tensor)
            pointers[k] = tensor.data_ptr()
        targets = (ctypes.c_void_p * len(outputs))(*[t.data_ptr() for t in outputs])
        rows = batch.numel()
        code = self.program(self.lanes(rows))
        arguments = rows, repeats, self.threads or torch.get_num_threads(), code.numbers, pointers, strides, targets
        return _Ready(code.run, arguments, [*kept, *outputs])

    def _batch(self, given: list[Tensor]) -> torch.Size:
        """The broadcast of the leading dimensions."""
        batch = torch.Size()
        for tensor, leaf in zip(given, self._inputs, strict=True):
            if tensor.dtype != leaf.dtype:
                raise DtypeError(f"the compiled function takes {leaf.dtype} where it got {tensor.dtype}")
            if tensor.requires_grad and torch.is_grad_enabled():
                raise ValueRangeError("a compiled function has no gradient: call the module itself, or without grad")
            if tensor.shape == leaf.shape:
                continue
            leading = tensor.dim() - len(leaf.shape)
            if leading < 0 or tensor.shape[leading:] != leaf.shape:
                want = ", ".join(("...", *map(str, leaf.shape)))
                raise ShapeError(f"the compiled function takes ({want}) where it got {tuple(tensor.shape)}")
            if tensor.shape[:leading] != batch:
                batch = torch.broadcast_shapes(batch, tensor.shape[:leading])
        return batch
