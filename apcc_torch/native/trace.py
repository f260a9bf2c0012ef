"""Traces a function of tensors and writes it out in scalar expressions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from apcc_torch.errors import CompileError
from apcc_torch.native.alike import Call
from apcc_torch.native.loops import looped
from apcc_torch.native.operators import MOVES, OPERATORS
from apcc_torch.native.reads import reads_of
from apcc_torch.native.routines import Routines
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Scalars
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.native.symbol import Symbol, at_example, symbol
from apcc_torch.native.values import Arithmetic, Value, kind_of
from apcc_torch.native.whole import UNKNOWN, Whole
from apcc_torch.repetition import recorded_by
from apcc_torch.settings import Settings

Function = Callable[..., Any]

# Keywords that say where a tensor lies and what it is made of: the tensor at the example says the latter.
_PLACEMENT = frozenset({"dtype", "layout", "device", "pin_memory", "memory_format", "non_blocking", "copy"})
# Torch chooses these by how the tensor at the example lies, and the entries lie alike.
_VIEWS = ("aten.view", "aten._unsafe_view")
_FLAGS = ("_is_compiling_flag", "_is_exporting_flag")


class Leaf(NamedTuple):
    """One tensor of an argument or a result: shape of one row, and type."""

    shape: tuple[int, ...]
    dtype: torch.dtype


class Trace(NamedTuple):
    """A function written out.

    scalars: Its expressions.
    inputs, outputs: Tensors of the flattened arguments and results.
    results: For each output the expressions of its entries, row by row.
    calls: The tensor operations that made the expressions.
    read: Numbers of the settings that were read meanwhile, of those that `traced` was told.
    """

    scalars: Scalars
    inputs: list[Leaf]
    outputs: list[Leaf]
    results: list[list[int]]
    calls: list[Call]
    read: list[int]


def traced(
    function: Function,
    example: tuple[Any, ...],
    held: Sequence[Tensor] = (),
    described: Sequence[Settings] = (),
    shares: bool = True,
) -> Trace:
    """Traces `function` at one row of arguments; what it holds is taken as constant.

    Args:
        function: Of (nested) tensors, without branches on their values.
        example: One row of arguments, without batch dimensions.
        held: Tensors that the function holds; `Scalars.held_at` has their numbers in this order.
        described: Settings that it holds, which are of account where it reads them.
        shares: Whether what it shares is written once, as `repetition.shared` has it, or at every place.

    Raises:
        CompileError: It cannot be traced, or uses an operation that is not in the table.
    """
    recorder = Recorder(held, shares)
    # Each argument a tensor of its own: two that are one tensor here may be two at a call.
    given = [leaf.detach().clone() for leaf in flattened(example)]
    inputs = [Leaf(tuple(leaf.shape), leaf.dtype) for leaf in given]
    symbols = recorder.inputs(given)
    try:
        with (
            reads_of(described) as read,
            torch.no_grad(),
            _compiling(),
            Whole(recorder),
            recorder,
            recorded_by(recorder),
        ):
            returned = function(*rebuilt(example, iter(symbols)))
    except CompileError:
        raise
    except Exception as error:  # torch raises many kinds here, and each means the same
        raise CompileError(f"the function cannot be traced: {error}") from error
    outcome = [recorder.value(leaf) for leaf in flattened(returned)]
    outputs = [Leaf(tuple(value.entries.shape), value.dtype) for value in outcome]
    results = [value.entries.flatten().tolist() for value in outcome]
    return Trace(recorder.arithmetic.scalars, inputs, outputs, results, recorder.calls, sorted(read))


@contextmanager
def _compiling() -> Iterator[None]:
    """What asks torch whether it is compiled hears that it is."""
    flags = {name: getattr(torch.compiler, name) for name in _FLAGS if hasattr(torch.compiler, name)}
    try:
        for name in flags:
            setattr(torch.compiler, name, True)
        yield
    finally:
        for name, before in flags.items():
            setattr(torch.compiler, name, before)


class Recorder(TorchDispatchMode):
    """Runs each of torch's operations on scalar expressions too.

    held, shares: See `traced`. inside: Whether an operation of its own is done, which is not noted.
    """

    def __init__(self, held: Sequence[Tensor] = (), shares: bool = True) -> None:
        super().__init__()
        self._routines = Routines(self) if shares else None
        self.arithmetic = Arithmetic()
        self.calls: list[Call] = []
        self._numbers = {id(tensor): number for number, tensor in enumerate(held)}
        self._memory = {tensor.untyped_storage().data_ptr() for tensor in held if tensor.numel()}
        self._held: dict[int, tuple[Tensor, Value]] = {}
        self.inside = False
        self._loops: list[int] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """No: what keeps torch's compiler away imports it, for half a second, and nothing is compiled here."""
        return False

    def inputs(self, given: list[Tensor]) -> list[Symbol]:
        """Symbols of the arguments."""
        symbols, counts = [], {FLOAT: 0, INT: 0, BOOL: 0}
        for leaf in given:
            kind = kind_of(leaf.dtype)
            first, counts[kind] = counts[kind], counts[kind] + leaf.numel()
            flat = [self.arithmetic.scalars.input(k, kind) for k in range(first, counts[kind])]
            entries = torch.tensor(flat, dtype=torch.int64).reshape(leaf.shape)
            symbols.append(symbol(Value(entries, leaf.dtype), leaf))
        return symbols

    @property
    def inner(self) -> int | None:
        """The innermost loop that is being written out, None outside of loops."""
        return self._loops[-1] if self._loops else None

    @contextmanager
    def _noting(self, noting: bool) -> Iterator[None]:
        """Inside, torch's operations are noted, or are not."""
        before, self.inside = self.inside, not noting
        try:
            yield
        finally:
            self.inside = before

    @contextmanager
    def within(self, loop: int) -> Iterator[None]:
        """What is noted inside is of this loop."""
        self._loops.append(loop)
        try:
            with self._noting(True):
                yield
        finally:
            self._loops.pop()

    def repeated(self, body: Callable[[Any], Any], state: Any, times: int, going: Callable[[Any], Tensor]) -> Any:
        """As `repetition.repeated`."""
        if times <= 1:
            return body(state) if times else state
        begun = going(state)
        with self._noting(False):
            return looped(self, body, state, times, going, begun)

    def shared(self, function: Function, args: tuple[Any, ...]) -> Any:
        """As `repetition.shared`."""
        if self._routines is None:
            return function(*args)
        with self._noting(False):
            return self._routines.called(function, args, tuple(self._loops))

    def symbols(self, like: list[Tensor], values: list[Value], indices: list[int]) -> list[Symbol]:
        """Tensors of the same forms, of these expressions one after the other."""
        symbols, number = [], 0
        for leaf, value in zip(like, values, strict=True):
            entries = torch.tensor(indices[number : (number := number + value.entries.numel())], dtype=torch.int64)
            symbols.append(symbol(Value(entries.reshape(value.entries.shape), value.dtype), at_example(leaf)))
        return symbols

    def truth(self, condition: Tensor) -> int:
        """Whether a condition holds anywhere in the row."""
        entries: list[int] = self.value(condition).entries.flatten().tolist()
        return self.arithmetic.folded("or", entries)

    def value(self, item: Any) -> Any:
        """Tensors replaced by their expressions; one that is no symbol is held by the function."""
        if isinstance(item, Symbol):
            return item.value
        if isinstance(item, Tensor):
            if id(item) not in self._held:
                number = self._numbers.get(id(item))
                if number is None and item.untyped_storage().data_ptr() in self._memory:
                    raise RuntimeError("it makes a tensor of one that it holds by other ways than torch's operations")
                self._held[id(item)] = item, self.arithmetic.held(item, number)
            return self._held[id(item)][1]
        if isinstance(item, (list, tuple)):
            return [self.value(i) for i in item]
        return item

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.called(str(func), func, args, kwargs or {})

    def called(self, name: str, func: Any, args: Any, kwargs: Any) -> Any:
        """What an operation (aten.mul.Tensor, for example) gives, as symbols; what it does inside is not noted."""
        if self.inside:
            return func(*args, **kwargs)
        self.inside = True
        try:
            return self._noted(name, func, args, kwargs)
        except NotImplementedError as error:
            raise CompileError(f"{name} cannot be compiled: {error}") from error
        finally:
            self.inside = False

    def _noted(self, name: str, func: Any, args: Any, kwargs: Any) -> Any:
        base = ".".join(name.split(".")[:2])
        if base == "aten._local_scalar_dense":
            raise RuntimeError(UNKNOWN)
        rule = OPERATORS.get(base)
        if base == "aten.copy_" and not isinstance(args[0], Symbol):
            raise NotImplementedError("it writes into what the function holds")
        rows = func(*at_example(args), **at_example(kwargs))
        first = len(self.arithmetic.scalars.expressions)
        given, named = self.value(args), {key: self.value(item) for key, item in kwargs.items()}
        if base.removeprefix("aten.") in MOVES:
            result = self._moved(Tensor.reshape if base in _VIEWS else func, given, named, rows)
        elif rule is not None:
            named = {key: item for key, item in named.items() if key not in _PLACEMENT}
            result = rule(self.arithmetic, _types(rows), *given, **named)
        else:
            raise NotImplementedError("no rule for it")
        _check(name, result, rows)
        made = [result] if isinstance(result, Value) else result or []
        if made and len(self.arithmetic.scalars.expressions) > first:
            self.calls.append(Call(first, len(self.arithmetic.scalars.expressions), made[0].entries.clone()))
        if isinstance(rows, Tensor):
            return symbol(result, rows)
        return None if rows is None else type(rows)([symbol(r, row) for r, row in zip(result, rows, strict=True)])

    def _moved(self, target: Any, args: Any, kwargs: Any, rows: Any) -> Any:
        kind = kind_of((rows if isinstance(rows, Tensor) else rows[0]).dtype)
        result = target(*self._entries(args, kind), **self._entries(kwargs, kind))
        if isinstance(result, Tensor):
            return Value(result, rows.dtype)
        return [Value(r, row.dtype) for r, row in zip(result, rows, strict=True)]

    def _entries(self, item: Any, kind: str) -> Any:
        """Values replaced by their entries, all of one kind, as torch promotes what it puts side by side."""
        if isinstance(item, Value):
            return self.arithmetic.entries(item, kind)
        if isinstance(item, list):
            return [self._entries(i, kind) for i in item]
        if isinstance(item, dict):
            return {k: self._entries(v, kind) for k, v in item.items()}
        return item


def _types(meta: Any) -> Any:
    if isinstance(meta, Tensor):
        return meta.dtype
    return None if meta is None else [m.dtype for m in meta]


def _check(name: str, result: Any, meta: Any) -> None:
    """What was written out has the shape that torch says it has."""
    pairs = [(result, meta)] if isinstance(meta, Tensor) else list(zip(result or (), meta or (), strict=True))
    for value, known in pairs:
        if value.entries.shape != known.shape:
            raise CompileError(f"{name} came out as {tuple(value.entries.shape)}, not {tuple(known.shape)}")
