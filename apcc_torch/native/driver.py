"""The part of a program that takes rows to lanes and back."""

from __future__ import annotations

from importlib.resources import files

import torch

from apcc_torch.native.layout import ARRAY, TYPE, counted, places
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
    for k, (leaf, start) in enumerate(zip(trace.inputs, inputs, strict=True)):
        kind, storage = kind_of(leaf.dtype), _STORAGE[leaf.dtype]
        source = f"static_cast<const {storage}*>(inputs[{k}]), stride[{k}]"
        loads.append(f"load{_SUFFIX[kind]}({source}, {counted(leaf)}, row, in.{ARRAY[kind]} + {start});")
    for k, (leaf, start) in enumerate(zip(trace.outputs, outputs, strict=True)):
        kind, storage = kind_of(leaf.dtype), _STORAGE[leaf.dtype]
        target = f"static_cast<{storage}*>(outputs[{k}]), {counted(leaf)}"
        stores.append(f"store{_SUFFIX[kind]}({target}, {counted(leaf)}, row, out.{ARRAY[kind]} + {start});")
    for output, into in carried:
        kind = kind_of(trace.outputs[output].dtype)
        size = f"{counted(trace.outputs[output])} * sizeof({TYPE[kind]})"
        array = ARRAY[kind]
        carry.append(f"std::memcpy(in.{array} + {inputs[into]}, out.{array} + {outputs[output]}, {size});")
    text = files(__package__).joinpath("driver.hpp").read_text()
    for word, lines in {"LOADS": loads, "STORES": stores, "CARRY": carry, "CALLS": calls}.items():
        text = text.replace(f"@{word}@", "\n            ".join(lines))
    return text.replace("@PARTS@", ", ".join(f"(const char*)part_{k}" for k in range(parts)))
