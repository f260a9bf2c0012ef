"""A library's header and source, from the functions that it offers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.tendon_limits import SolverStatus
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.exporting.functions import Function
from apcc_torch.exporting.structs import Struct, declared, leaves, struct
from apcc_torch.native.layout import ARRAY, places
from apcc_torch.native.source import prologue
from apcc_torch.native.statements import Body, body
from apcc_torch.native.trace import Trace, traced
from apcc_torch.native.values import kind_of

TYPES = {"before": "state"}
"""Arguments whose structs have another name."""
STATUS_WORDS = {
    "CONVERGED": "every sensor is within both thresholds",
    "SETTLED": "the step is negligible: nearby, the model fits no better",
    "ITERATION_LIMIT": "still under way; of a law of the shape until the arm rests",
    "INVALID": "nothing to estimate from: the command is held",
    "MISFIT": "settled far from the sensors: another branch of the shape, or another arm",
    "UNTOLD": "what is measured leaves a section to what was believed before: rest lengths rest",
}
LIMIT_WORDS = {
    "FREE": "no limit mattered",
    "LIMITED": "a coordinate of q_d is held at its bound",
    "INFEASIBLE": "the limits contradict each other",
    "NOT_FINITE": "the target is not finite: the command is held",
}


class Compiled(NamedTuple):
    """A function with its statements."""

    function: Function
    trace: Trace
    body: Body
    results: tuple[Any, ...]


class Parameter(NamedTuple):
    """An argument of a function in C. takes, gives: Whether it is read, and written. struct: None for a number."""

    name: str
    struct: Struct | None
    takes: bool
    gives: bool


class Library:
    """Functions and structs under one name.

    Args:
        prefix: Before every name in C.
        real: What is computed in, float64 or float32.
        functions: What it offers.
        constants: Arrays that it tells: name to values and what they are, with the unit.
        origin: Where it comes from, in a sentence.

    Raises:
        CompileError: A module cannot be traced.
    """

    def __init__(
        self,
        prefix: str,
        real: torch.dtype,
        functions: Sequence[Function],
        constants: dict[str, tuple[Tensor, str]],
        origin: str,
    ) -> None:
        self.prefix, self.real, self.constants, self.origin = prefix, real, constants, origin
        self.compiled = [_compiled(function) for function in functions]
        self.structs: dict[str, Struct] = {}
        for each in self.compiled:
            named = [*zip(each.function.takes, each.function.example, strict=True)]
            for name, item in [*named, *zip(each.function.gives, each.results, strict=True)]:
                if isinstance(item, tuple):
                    self.structs[TYPES.get(name, name)] = struct(TYPES.get(name, name), item, real, prefix)

    def parameters(self, each: Compiled) -> list[Parameter]:
        """The arguments of a function in C: what it takes, then what it gives beside."""
        takes, gives = each.function.takes, each.function.gives
        order = dict.fromkeys((*takes, *gives))
        return [
            Parameter(name, self.structs.get(TYPES.get(name, name)), name in takes, name in gives) for name in order
        ]

    def signature(self, each: Compiled) -> str:
        """A function's declaration, without the semicolon."""
        said = []
        for p in self.parameters(each):
            kept = "" if p.gives else "const "
            said.append(f"double {p.name}" if p.struct is None else f"{kept}{self.prefix}_{p.struct.name} *{p.name}")
        return f"void {self.prefix}_{each.function.name}({', '.join(said) or 'void'})"

    def header(self) -> str:
        """The header, plain C."""
        P, p = self.prefix.upper(), self.prefix
        real = "double" if self.real == torch.float64 else "float"
        parts = [
            f"/* {self.origin}\n   Plain C. Nothing is allocated, nothing is kept outside of the structs. */",
            f"#ifndef {P}_H\n#define {P}_H\n\n#include <stdbool.h>\n#include <stdint.h>\n",
            '#ifdef __cplusplus\nextern "C" {\n#endif\n',
            f"typedef {real} {p}_real;\n",
            *_enums(P, p),
            *(f"{declared(made, p)}\n" for made in self.structs.values()),
            *(
                f"/** {told} */\nextern const {p}_real {p}_{name}[{values.numel()}];\n"
                for name, (values, told) in self.constants.items()
            ),
            *(f"/** {each.function.meaning} */\n{self.signature(each)};\n" for each in self.compiled),
            f"#ifdef __cplusplus\n}}\n#endif\n\n#endif /* {P}_H */\n",
        ]
        return "\n".join(parts)

    def arithmetic(self) -> str:
        """The header of the source alone: what its statements are written in."""
        return f"// {self.origin}\n#pragma once\n{prologue(1, self.real)}"

    def source(self) -> str:
        """The source."""
        p = self.prefix
        parts = [
            f"// {self.origin}",
            "// Written by a program: straight-line arithmetic, with the numbers of the arm and its controller in",
            "// tables. The names are those of expressions, not of quantities: read the Python modules instead.",
            f'#include "{p}.h"\n#include "{p}_arithmetic.hpp"',
            _COPIES,
        ]
        for name, (values, _) in self.constants.items():
            parts.append(f"extern const {p}_real {p}_{name}[{values.numel()}] = {{{self._listed(values.tolist())}}};")
        parts += [self._function(each) for each in self.compiled]
        return "\n\n".join(parts) + "\n"

    def _listed(self, values: Sequence[float]) -> str:
        return ", ".join(literal(value, self.real) for value in values)

    def _function(self, each: Compiled) -> str:
        inner = f"of_{each.function.name}"
        numbers = [each.trace.scalars.number(index) for index in each.body.numbers] or [0.0]
        table = f"const REAL numbers[{len(numbers)}] = {{{self._listed(numbers)}}};"
        now = each.function.stamp.replace(".", "->") if self.real == torch.float32 else ""
        lines = [
            f"namespace {{\nnamespace {inner} {{",
            each.body.structs,
            table,
            *each.body.functions,
            f"}}  // namespace {inner}\n}}  // namespace\n",
            f'extern "C" {self.signature(each)} {{',
            f"    using namespace {inner};",
            *([f"    const double now = {now};"] if now else []),
            "    Inputs in{};\n    Scratch s;\n    Outputs out;",
            *(f"    {line}" for line in self._copies(each, each.function.takes, each.function.example, "take", now)),
            *(f"    {line}" for line in each.body.calls),
            *(f"    {line}" for line in self._copies(each, each.function.gives, each.results, "give", now)),
            "}",
        ]
        return "\n".join(lines)

    def _copies(self, each: Compiled, names: Sequence[str], items: Sequence[Any], way: str, now: str) -> Iterator[str]:
        """Lines that bring structs into the statements' arrays, or back."""
        array = "in" if way == "take" else "out"
        tensors = each.trace.inputs if way == "take" else each.trace.outputs
        starts = iter(places(tensors)[0])
        for name, item in zip(names, items, strict=True):
            for k, (_, _, leaf) in enumerate(leaves(item)):
                kind, start = kind_of(leaf.dtype), next(starts)
                place = f"{array}.{ARRAY[kind]} + {start}"
                kept = self.structs.get(TYPES.get(name, name))
                member = None if kept is None else kept.members[k]
                stamp = bool(now) and leaf.dtype == torch.float64
                if member is not None and not member.size:
                    continue
                storage = "double" if member is None else member.ctype
                size = 1 if member is None else member.size
                at = f"&{name}" if member is None else f"&{name}->{member.name}"
                storage = "unsigned char" if storage == "bool" and way == "take" else storage
                where = f"{at}, {place}" if way == "give" else f"{place}, {at}"
                yield f"{way}{'_since' if stamp else f'<{storage}>'}({where}, {size}{', now' if stamp else ''});"


def literal(value: float, real: torch.dtype) -> str:
    """A number in C++ that reads back as it is."""
    if value != value:
        return "NAN"
    if value in (float("inf"), float("-inf")):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{float(torch.tensor(value, dtype=real))!r}{'' if real == torch.float64 else 'f'}"


def _compiled(function: Function) -> Compiled:
    with torch.no_grad():
        given = function.module(*function.example)
    results = (given,) if len(function.gives) == 1 else given
    trace = traced(function.module, function.example)
    return Compiled(function, trace, body(trace), results)


def _enums(P: str, p: str) -> Iterator[str]:
    told: dict[str, tuple[type[IntEnum], dict[str, str], str]] = {
        "status": (FeedbackStatus, STATUS_WORDS, "How the estimate of a step ended."),
        "limits": (SolverStatus, LIMIT_WORDS, "How the limits of the command mattered."),
    }
    for name, (kind, words, meaning) in told.items():
        lines = "\n".join(f"    {P}_{each.name} = {each.value}, /**< {words[each.name]} */" for each in kind)
        yield f"/** {meaning} */\nenum {p}_{name} {{\n{lines}\n}};\n"


_COPIES = """\
namespace {

template <class T, class To>
inline void take(To* to, const void* from, int n) {
    const unsigned char* bytes = static_cast<const unsigned char*>(from);
    for (int i = 0; i < n; ++i) {
        T x;
        std::memcpy(&x, bytes + i * sizeof x, sizeof x);
        to[i] = static_cast<To>(x);
    }
}

template <class T, class From>
inline void give(void* to, const From* from, int n) {
    unsigned char* bytes = static_cast<unsigned char*>(to);
    for (int i = 0; i < n; ++i) {
        const T x = static_cast<T>(from[i]);
        std::memcpy(bytes + i * sizeof x, &x, sizeof x);
    }
}

// Times are told to arithmetic of single precision as what has passed since now: they need more digits than it has.
template <class To>
[[maybe_unused]] inline void take_since(To* to, const void* from, int n, double now) {
    const unsigned char* bytes = static_cast<const unsigned char*>(from);
    for (int i = 0; i < n; ++i) {
        double x;
        std::memcpy(&x, bytes + i * sizeof x, sizeof x);
        to[i] = static_cast<To>(x - now);
    }
}

template <class From>
[[maybe_unused]] inline void give_since(void* to, const From* from, int n, double now) {
    unsigned char* bytes = static_cast<unsigned char*>(to);
    for (int i = 0; i < n; ++i) {
        const double x = now + static_cast<double>(from[i]);
        std::memcpy(bytes + i * sizeof x, &x, sizeof x);
    }
}

}  // namespace"""
