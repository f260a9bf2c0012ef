"""A module compiled to machine code, called like the module."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from apcc_torch.errors import CompileError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.native.build import compiler, widest_vector
from apcc_torch.native.fingerprint import Fingerprint, fingerprint
from apcc_torch.native.kept_program import Program, kept_program
from apcc_torch.native.methods import module_of
from apcc_torch.native.source import Plan
from apcc_torch.native.structure import any_double, described, flattened, rebuilt
from apcc_torch.native.trace import Leaf, Trace, traced
from apcc_torch.part import row_tensors
from apcc_torch.shapes import broadcast

FORMS = 256
"""How many sets of shapes are remembered; beyond, all are found anew."""


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


class Ready:
    """Machine code with its arguments and results, all of which stay alive as long as it may run."""

    __slots__ = ("_arguments", "_given", "_pointers", "_results", "_run", "_targets")

    def __init__(
        self, code: Program, form: _Form, given: list[Tensor], results: list[Tensor], repeats: int, threads: int
    ) -> None:
        self._given, self._results, self._run = given, results, code.run
        self._pointers = (ctypes.c_void_p * len(given))(*[tensor.data_ptr() for tensor in given])
        self._targets = (ctypes.c_void_p * len(results))(*[tensor.data_ptr() for tensor in results])
        where = self._pointers, form.strides, self._targets
        self._arguments = (form.batch.numel(), repeats, threads, code.numbers, *where)

    def __call__(self) -> None:
        """Runs it."""
        self._run(*self._arguments)

    def read_from(self, number: int, tensor: Tensor) -> None:
        """Makes this the argument of that number; it lies as the one before."""
        self._given[number] = tensor
        self._pointers[number] = tensor.data_ptr()

    def write_to(self, number: int, tensor: Tensor) -> None:
        """Makes this the result of that number, likewise."""
        self._results[number] = tensor
        self._targets[number] = tensor.data_ptr()


class _Form(NamedTuple):
    """How arguments and results of one set of shapes lie.

    batch: Leading shape of the results. strides: Entries from row to row of each argument, 0 where all rows share it.
    expanded: The shape that an argument is to have; None where it has it. outputs: Shapes and types of the results.
    """

    batch: torch.Size
    strides: Any
    expanded: list[tuple[int, ...] | None]
    outputs: list[tuple[tuple[int, ...], torch.dtype]]


class NativeFunction:
    """A module's `forward`, another method of it, or a function of a file, as machine code for any number of rows.

    It is traced at one row of arguments, written out in scalar arithmetic and built into a shared library, which is
    kept and found again by the module's settings, the code and the machine. What the module holds is taken as it is
    now, but for the tensors that it holds for every row (`settings.row_tensors`), which are read at each call.
    Arguments may carry leading dimensions, which broadcast; rows are worked on side by side in the lanes of the
    machine's vectors, and over `threads` threads.

    Not differentiable, on the CPU only, and without the argument checks of the module itself, which the first, eager
    call at the example has made. A product with a constant zero is zero, even of what is not finite.

    Args:
        module: Or `module.method`, or `function`: of (nested tuples of) tensors, without branches on their values.
        example: One row of arguments, without leading dimensions.
        carries: The first result (or the only one) has the form of the first argument, and is its next value: calls may
            then repeat the function.
        threads: Over which large batches are spread; None for torch's number.

    Raises:
        CompileError: It cannot be compiled, or there is no compiler.

    Example:
        >>> backbone, L0 = PCCBackbone(1), torch.tensor([0.2])
        >>> fast = NativeFunction(backbone.tip_and_jacobian, (torch.zeros(3), L0))
        >>> tip, J = fast(torch.zeros(4096, 3), L0)
        >>> tip[0], J.shape
        (tensor([0.0000, 0.0000, 0.2000]), torch.Size([4096, 3, 3]))
    """

    def __init__(
        self,
        module: nn.Module | Callable[..., Any],
        example: tuple[Any, ...],
        carries: bool = False,
        threads: int | None = None,
    ) -> None:
        self.module, self._named = module_of(module)
        self.threads = threads
        self.rows = [tensor for tensor, _ in row_tensors(self.module).values()]
        with torch.inference_mode():
            self.traced, extra = one_row(self.module)
            self.like = self.traced(*example, *extra)
        self.example = (*example, *extra)
        given, returned = flattened(self.example), flattened(self.like)
        self._inputs = [Leaf(tuple(t.shape), t.dtype) for t in given]
        self._outputs = [Leaf(tuple(t.shape), t.dtype) for t in returned]
        for tensor in given:
            if tensor.device.type != "cpu":
                raise CompileError(f"only the CPU's code is compiled, the example is on {tensor.device}")
        self._carried = self._pairs(example[0]) if carries else []
        held = [t for t in (*self.module.buffers(), *self.module.parameters()) if t.is_floating_point()]
        # Where anything is of double precision everything is, inside: what torch would round in between is not.
        self._dtype = torch.float64 if any_double(given + returned + held) else torch.float32
        # Here, not at each call: it looks for the compiler.
        self._widest = widest_vector(compiler()) // self._dtype.itemsize
        self._programs: dict[int, Program] = {}
        self._forms: dict[tuple[tuple[torch.Size, torch.dtype], ...], _Form] = {}
        self._traces: dict[str, Trace] = {}  # by the module's exact name: what it holds may have been changed

    def _pairs(self, given: Any) -> list[tuple[int, int]]:
        first = self.like[0] if type(self.like) is tuple else self.like
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
            told = fingerprint(self.module, *form)
            planned = partial(self._plan, lanes, told)
            self._programs[lanes] = kept_program(told, self._dtype, planned, self._named)
        return self._programs[lanes]

    def _plan(self, lanes: int, told: Fingerprint) -> Plan:
        now = told.exact()
        if now not in self._traces:
            with torch.inference_mode(False):
                self._traces = {now: traced(self.traced, self.example, told.held, told.described)}
        return Plan(self._traces[now], lanes, self._dtype, self._carried)

    def lanes(self, rows: int) -> int:
        """How many rows are worked on at once in a batch of `rows`."""
        return 1 if rows == 1 else self._widest

    def __call__(self, *args: Any, repeats: int = 1) -> Any:
        """The module's result for these arguments; with `repeats`, the last of so many calls that each carry on.

        Raises:
            ShapeError, DtypeError: The arguments are not the example's with leading dimensions.
            ValueRangeError: `repeats` is not positive, or an argument asks for a gradient.
        """
        given = [*flattened(args), *self.rows]
        if len(given) != len(self._inputs):
            wanted = len(self._inputs) - len(self.rows)
            raise ShapeError(f"the compiled function takes {wanted} tensors, got {len(given) - len(self.rows)}")
        if repeats < 1 or (repeats > 1 and not self._carried):
            raise ValueRangeError(f"repeats must be 1, or more where the function carries its result; got {repeats}")
        form = self._form(given)
        outputs = [torch.empty(shape, dtype=dtype) for shape, dtype in form.outputs]
        if form.batch.numel():
            self._ready(given, outputs, form, repeats)()
        return rebuilt(self.like, iter(outputs))

    def blank(self, given: list[Tensor]) -> Any:
        """What a call with these flattened arguments returns, of zeros."""
        form = self._form([*given, *self.rows])
        return rebuilt(self.like, (torch.zeros(shape, dtype=dtype) for shape, dtype in form.outputs))

    def bound(self, given: list[Tensor], outputs: list[Tensor]) -> Ready:
        """A call on tensors that stay where they are, which may be made again and again.

        Args:
            given: The flattened arguments, contiguous.
            outputs: The flattened results, contiguous, of the arguments' leading shape; each call overwrites them.

        Raises:
            ShapeError, DtypeError: They are not the example's with leading dimensions.
        """
        given = [*given, *self.rows]
        return self._ready(given, outputs, self._form(given))

    def _ready(self, given: list[Tensor], outputs: list[Tensor], form: _Form, repeats: int = 1) -> Ready:
        """A call that needs nothing more."""
        kept = [
            (tensor if shape is None else tensor.expand(shape)).contiguous()
            for tensor, shape in zip(given, form.expanded, strict=True)
        ]
        code = self.program(self.lanes(form.batch.numel()))
        return Ready(code, form, kept, outputs, repeats, self.threads or torch.get_num_threads())

    def _form(self, given: list[Tensor]) -> _Form:
        """How arguments of these shapes lie, found once for each set of shapes."""
        told = tuple([(tensor.shape, tensor.dtype) for tensor in given])
        form = self._forms.get(told)
        if form is None:
            if len(self._forms) >= FORMS:
                self._forms.clear()
            form = self._forms[told] = self._found(given)
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given):
            raise ValueRangeError("a compiled function has no gradient: call the module itself, or without grad")
        return form

    def _found(self, given: list[Tensor]) -> _Form:
        batch = self._batch(given)
        strides = (ctypes.c_long * len(given))()
        expanded: list[tuple[int, ...] | None] = []
        for k, (tensor, leaf) in enumerate(zip(given, self._inputs, strict=True)):
            own = tensor.shape == leaf.shape
            strides[k] = 0 if own else torch.Size(leaf.shape).numel()
            whole = (*batch, *leaf.shape)
            expanded.append(None if own or tensor.shape == whole else whole)
        outputs = [((*batch, *leaf.shape), leaf.dtype) for leaf in self._outputs]
        return _Form(batch, strides, expanded, outputs)

    def _batch(self, given: list[Tensor]) -> torch.Size:
        """The broadcast of the leading dimensions."""
        batch = torch.Size()
        for tensor, leaf in zip(given, self._inputs, strict=True):
            if tensor.dtype != leaf.dtype:
                raise DtypeError(f"the compiled function takes {leaf.dtype} where it got {tensor.dtype}")
            if tensor.shape == leaf.shape:
                continue
            leading = tensor.dim() - len(leaf.shape)
            if leading < 0 or tensor.shape[leading:] != leaf.shape:
                want = ", ".join(("...", *map(str, leaf.shape)))
                raise ShapeError(f"the compiled function takes ({want}) where it got {tuple(tensor.shape)}")
            batch = broadcast(batch, tensor.shape[:leading])
        return batch
