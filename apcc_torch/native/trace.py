"""Traces a function of tensors and writes it out in scalar expressions."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.export.graph_signature import InputKind
from torch.fx import config

from apcc_torch.errors import CompileError
from apcc_torch.native.operators import MOVES, OPERATORS
from apcc_torch.native.scalars import Scalars
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.native.values import Arithmetic, Value, kind_of

Function = Callable[..., Any]

# Keywords that say where a tensor lies and what it is made of: the graph's metadata says the latter.
_PLACEMENT = frozenset({"dtype", "layout", "device", "pin_memory", "memory_format", "non_blocking", "copy"})


class Leaf(NamedTuple):
    """One tensor of an argument or a result: shape of one row, and type."""

    shape: tuple[int, ...]
    dtype: torch.dtype


class Trace(NamedTuple):
    """A function written out.

    scalars: Its expressions.
    inputs, outputs: Tensors of the flattened arguments and results.
    results: For each output the expressions of its entries, row by row.
    """

    scalars: Scalars
    inputs: list[Leaf]
    outputs: list[Leaf]
    results: list[list[int]]


class _Function(nn.Module):
    """A function of tensors as a module, which is what torch exports."""

    def __init__(self, function: Function) -> None:
        super().__init__()
        self.function = function

    def forward(self, *args: Any) -> Any:
        return self.function(*args)


def traced(function: Function, example: tuple[Any, ...]) -> Trace:
    """Traces `function` at one row of arguments; what it holds is taken as constant.

    Args:
        function: Of (nested) tensors, without branches on their values.
        example: One row of arguments, without batch dimensions.

    Raises:
        CompileError: It cannot be traced, or uses an operation that is not in the table.
    """
    # Each argument a tensor of its own: torch takes two that are one tensor for one argument.
    given = [leaf.detach().clone() for leaf in flattened(example)]
    example = rebuilt(example, iter(given))
    try:
        with torch.no_grad(), _without_stacks():
            program = torch.export.export(_Function(function), tuple(example), strict=False)
    except Exception as error:  # torch raises many kinds here, and each means the same
        raise CompileError(f"the function cannot be traced: {error}") from error
    return _Writer(program, given).run()


@contextmanager
def _without_stacks() -> Iterator[None]:
    """Keeps torch from noting where each operation was called, a fifth of the time of a trace; nobody reads it here."""
    before = getattr(config, "do_not_emit_stack_traces", None)  # None: this torch has no such switch
    if before is None:
        yield
        return
    config.do_not_emit_stack_traces = True
    try:
        yield
    finally:
        config.do_not_emit_stack_traces = before


class _Writer:
    """Runs an exported graph on scalar expressions."""

    def __init__(self, program: torch.export.ExportedProgram, given: list[Tensor]) -> None:
        self.program = program
        self.arithmetic = Arithmetic()
        self.given = given
        self.inputs = [Leaf(tuple(leaf.shape), leaf.dtype) for leaf in given]

    def run(self) -> Trace:
        """The whole graph, node by node."""
        signature = {spec.arg.name: spec for spec in self.program.graph_signature.input_specs}
        values: dict[str, Any] = {}
        number = position = 0
        for node in self.program.graph.nodes:
            if node.op == "placeholder":
                spec = signature[node.name]
                if spec.kind != InputKind.USER_INPUT:
                    values[node.name] = self.arithmetic.held(self._held(spec))
                elif isinstance(node.meta.get("val"), Tensor):
                    leaf = self.inputs[position]
                    values[node.name], number = self._input(leaf, number), number + _count(leaf)
                    position += 1
                else:
                    values[node.name] = node.meta.get("val")
            elif node.op == "call_function":
                values[node.name] = self._called(node, values)
            elif node.op == "output":
                return self._trace(_resolved(node.args[0], values))
            else:
                raise CompileError(f"the trace holds {node.op}, which cannot be compiled")
        raise CompileError("the function returns nothing")

    def _held(self, spec: Any) -> Tensor:
        state, constants = self.program.state_dict, self.program.constants
        return state[spec.target] if spec.target in state else constants[spec.target]

    def _input(self, leaf: Leaf, number: int) -> Value:
        kind = kind_of(leaf.dtype)
        flat = [self.arithmetic.scalars.input(number + i, kind) for i in range(_count(leaf))]
        return Value(torch.tensor(flat, dtype=torch.int64).reshape(leaf.shape), leaf.dtype)

    def _called(self, node: torch.fx.Node, values: dict[str, Any]) -> Any:
        args, kwargs = _resolved(node.args, values), _resolved(dict(node.kwargs), values)
        if node.target is operator.getitem:
            return args[0][args[1]]
        name = str(node.target)  # aten.mul.Tensor
        base = name.rsplit(".", 1)[0]
        meta = node.meta.get("val")
        try:
            if base.removeprefix("aten.") in MOVES:
                return self._moved(node.target, args, kwargs, meta)
            rule = OPERATORS.get(base)
            if rule is None:
                raise NotImplementedError("no rule for it")
            kwargs = {k: v for k, v in kwargs.items() if k not in _PLACEMENT}
            result = rule(self.arithmetic, _types(meta), *args, **kwargs)
        except NotImplementedError as error:
            raise CompileError(f"{name} cannot be compiled: {error}") from error
        _check(name, result, meta)
        return result

    def _moved(self, target: Any, args: Any, kwargs: Any, meta: Any) -> Any:
        kind = kind_of((meta if isinstance(meta, Tensor) else meta[0]).dtype)
        result = target(*self._entries(args, kind), **self._entries(kwargs, kind))
        if isinstance(result, Tensor):
            return Value(result, meta.dtype)
        return [Value(r, m.dtype) for r, m in zip(result, meta, strict=True)]

    def _entries(self, item: Any, kind: str) -> Any:
        """Values replaced by their entries, all of one kind, as torch promotes what it puts side by side."""
        if isinstance(item, Value):
            return self.arithmetic.entries(item, kind)
        if isinstance(item, list):
            return [self._entries(i, kind) for i in item]
        if isinstance(item, dict):
            return {k: self._entries(v, kind) for k, v in item.items()}
        return item

    def _trace(self, returned: Any) -> Trace:
        outcome = [value for value in returned if isinstance(value, Value)]
        outputs = [Leaf(tuple(value.entries.shape), value.dtype) for value in outcome]
        results = [value.entries.flatten().tolist() for value in outcome]
        return Trace(self.arithmetic.scalars, self.inputs, outputs, results)


def _count(leaf: Leaf) -> int:
    return int(torch.Size(leaf.shape).numel())


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


def _resolved(item: Any, values: dict[str, Any]) -> Any:
    """Nodes replaced by what they stand for."""
    if isinstance(item, torch.fx.Node):
        return values[item.name]
    if isinstance(item, (list, tuple)):
        return [_resolved(i, values) for i in item]
    if isinstance(item, dict):
        return {k: _resolved(v, values) for k, v in item.items()}
    return item
