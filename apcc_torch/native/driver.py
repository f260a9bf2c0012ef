"""The part of a program that takes rows to lanes and back."""

from __future__ import annotations

from importlib.resources import files

import torch

from apcc_torch.native.layout import ARRAY, TYPE, counted, places
from apcc_torch.native.ordering import needed
from apcc_torch.native.scalars import BOOL, FLOAT, INT
from apcc_torch.native.trace import Trace
from apcc_torch.native.values import kind_of

_STORAGE = {
    torch.float64: "double",
    torch.float32: "float",
    torch.bool: "unsigned char",
    torch.int64: "long long",
    torch.int32: "int",
}
_SUFFIX = {FLOAT: "", INT: "_int", BOOL: "_bool"}


def driver(trace: Trace, parts: int, calls: list[str], carried: list[tuple[int, int]]) -> str:
    """C++ that runs a program on rows.

    Args:
        trace: From `traced`.
        parts: How many functions the program has.
        calls: What runs them.
        carried: Pairs (output, input): what a repetition hands to the next.
    """
    inputs, outputs = places(trace.inputs)[0], places(trace.outputs)[0]
    loads, stores, carry = [], [], []
    asked = _asked(trace)
    for k, (leaf, start) in enumerate(zip(trace.inputs, inputs, strict=True)):
        kind = kind_of(leaf.dtype)
        if not asked[kind].isdisjoint(range(start, start + counted(leaf))):  # what nothing asks for stays where it is
            source = f"static_cast<const {_STORAGE[leaf.dtype]}*>(inputs[{k}]), stride[{k}]"
            loads.append(f"load{_SUFFIX[kind]}<{counted(leaf)}>({source}, row, rows, in.{ARRAY[kind]} + {start});")
    for k, (leaf, start) in enumerate(zip(trace.outputs, outputs, strict=True)):
        if counted(leaf):
            kind, target = kind_of(leaf.dtype), f"static_cast<{_STORAGE[leaf.dtype]}*>(outputs[{k}])"
            stores.append(f"store{_SUFFIX[kind]}<{counted(leaf)}>({target}, row, out.{ARRAY[kind]} + {start});")
    for output, into in carried:
        kind = kind_of(trace.outputs[output].dtype)
        size = f"{counted(trace.outputs[output])} * sizeof({TYPE[kind]})"
        array = ARRAY[kind]
        carry.append(f"std::memcpy(in.{array} + {inputs[into]}, out.{array} + {outputs[output]}, {size});")
    text = "".join(files(__package__).joinpath(name).read_text() for name in ("rows.hpp", "driver.hpp"))
    for word, lines in {"LOADS": loads, "STORES": stores, "CARRY": carry, "CALLS": calls}.items():
        text = text.replace(f"@{word}@", "\n            ".join(lines))
    return text.replace("@PARTS@", ", ".join(f"(const char*)part_{k}" for k in range(parts)))


def _asked(trace: Trace) -> dict[str, set[int]]:
    """The numbers of the inputs on which a result depends, of each kind."""
    numbers: dict[str, set[int]] = {kind: set() for kind in (FLOAT, INT, BOOL)}
    _, counts = needed(trace.scalars, [index for result in trace.results for index in result])
    for expression, asked in zip(trace.scalars.expressions, counts, strict=True):
        if asked and expression.op == "input":
            numbers[expression.kind].add(int(expression.value or 0))
    return numbers
