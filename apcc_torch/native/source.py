"""Writes a trace as a C++ program that works on several rows at once, one a lane."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files

import torch

from apcc_torch.native.driver import driver
from apcc_torch.native.layout import ARRAY, TYPE, Layout, counted, laid_out, places
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Expression
from apcc_torch.native.trace import Trace
from apcc_torch.native.values import kind_of

_SPLAT = {FLOAT: "splat", INT: "splat_int", BOOL: "splat_bool"}
_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|",
    "lt": "<", "le": "<=", "eq": "==", "ne": "!=",
}  # fmt: skip
_SIGNATURE = (
    "void part_{}([[maybe_unused]] const Inputs& in, [[maybe_unused]] const REAL* __restrict k, "
    "[[maybe_unused]] Scratch& s, [[maybe_unused]] Outputs& out)"
)
_LARGEST_OF_FORM = 16.0
# The functions of lanes.hpp whose names differ from the operation's with an underscore behind it.
_CALLS = {"float": "real", "int": "integer"}


@dataclass
class Source:
    """A program in files that compile one by one.

    header: Common to all.
    parts: Bodies, each with the header before it.
    lanes: Rows that it works on at once.
    numbers: What it reads in place of constants, so modules that differ in these alone share a library.
    """

    header: str
    parts: list[str]
    lanes: int
    numbers: list[float]

    def name(self) -> str:
        """What tells its text from others (32 hexadecimal digits); the numbers have no part in it."""
        return hashlib.sha256("\0".join((self.header, *self.parts)).encode()).hexdigest()[:32]


@dataclass
class Body:
    """The statements of a trace.

    structs: The types Inputs, Scratch and Outputs, and the functions' declarations.
    functions: Each its share of the statements.
    calls: What runs them, with `in`, `numbers`, `s` and `out` at hand.
    numbers: What they read in place of constants.
    """

    structs: str
    functions: list[str]
    calls: list[str]
    numbers: list[float]


def body(trace: Trace, loops: bool = False) -> Body:
    """The statements of a trace, to stand behind `prologue`.

    Args:
        trace: From `traced`.
        loops: Whether the rounds of a loop are written once, see `native.loops`.
    """
    writer = _Writer(trace, laid_out(trace, loops))
    functions = [writer.part(k) for k in range(writer.parts)]
    calls = writer.calls()
    return Body(writer.structs(), functions, calls, writer.numbers)


def prologue(lanes: int, dtype: torch.dtype) -> str:
    """The arithmetic that statements are written in.

    Args:
        lanes: Rows at once; 1 for plain numbers.
        dtype: What is computed in, float64 or float32.
    """
    return f"{_settings(lanes, dtype)}\n{files(__package__).joinpath('lanes.hpp').read_text()}"


def program(trace: Trace, lanes: int, dtype: torch.dtype, carried: list[tuple[int, int]], files_wanted: int) -> Source:
    """The program of a trace.

    Args:
        trace: From `traced`.
        lanes: Rows at once; 1 for plain numbers.
        dtype: What it computes in, float64 or float32.
        carried: Pairs (output, input): what a repetition hands to the next.
        files_wanted: How many files the parts are spread over.
    """
    made = body(trace)
    # Before the settings, whose names a header may use as well.
    header = f"#include <thread>\n#include <vector>\n{prologue(lanes, dtype)}\n{made.structs}"
    groups: list[list[str]] = [[] for _ in range(max(1, min(files_wanted, len(made.functions))))]
    for k, text in enumerate(made.functions):
        groups[k % len(groups)].append(text)
    groups[0].append(driver(trace, made.calls, carried))
    return Source(header, ["\n".join(group) for group in groups], lanes, made.numbers)


class _Writer:
    """Writes the parts of a trace, each expression where the layout has it."""

    def __init__(self, trace: Trace, layout: Layout) -> None:
        self.layout = layout
        self.expressions = layout.expressions
        self.numbers: list[float] = []
        self._named = {index: f"t{k}" for k, index in enumerate(i for part in layout.parts for i in part)}
        self._number_of: dict[int, int] = {}
        self.parts = len(layout.parts)
        starts, self.inputs = places(trace.inputs)
        self.places = [
            start + i for leaf, start in zip(trace.inputs, starts, strict=True) for i in range(counted(leaf))
        ]
        self.targets: dict[int, list[str]] = {}
        self.plain: list[str] = []  # results that no statement computes
        starts, self.outputs = places(trace.outputs)
        for leaf, start, row in zip(trace.outputs, starts, layout.results, strict=True):
            for k, index in enumerate(row, start):
                place = f"out.{ARRAY[kind_of(leaf.dtype)]}[{k}]"
                if index in layout.part_of:
                    self.targets.setdefault(index, []).append(place)
                else:
                    self.plain.append(f"{place} = {self._splatted(index, -1)};")

    def structs(self) -> str:
        """What the parts share: their types and their names."""
        lines = []
        for name, sizes in {"Inputs": self.inputs, "Scratch": self.layout.sizes, "Outputs": self.outputs}.items():
            fields = " ".join(f"{TYPE[k]} {ARRAY[k]}[{max(n, 1)}];" for k, n in sizes.items())
            lines.append(f"struct {name} {{ {fields} }};")
        lines += [f"{_SIGNATURE.format(k)};" for k in range(self.parts)]
        return "\n".join(lines)

    def part(self, k: int) -> str:
        """One function: its share of the statements."""
        lines = [f"__attribute__((noinline)) {_SIGNATURE.format(k)} {{"]
        for index in self.layout.parts[k]:
            expression = self.expressions[index]
            name = self._named[index]
            lines.append(f"const {TYPE[expression.kind]} {name} = {self._formula(expression, k)};")
            if index in self.layout.slots:
                lines.append(f"s.{ARRAY[expression.kind]}[{self.layout.slots[index]}] = {name};")
            lines += [f"{place} = {name};" for place in self.targets.get(index, ())]
        if k == self.parts - 1:
            lines += self.plain
        return "\n".join((*lines, "}"))

    def calls(self) -> list[str]:
        """What runs the parts, a loop's as often as it has rounds."""
        slots, lines = self.layout.slots, []
        begins = {loop.first: loop for loop in self.layout.loops}
        ends = {loop.last: loop for loop in self.layout.loops}
        for k in range(self.parts):
            if k in begins:
                loop = begins[k]
                for each in loop.handed:
                    first = self._splatted(each.first, -1).replace("k[", "numbers[")
                    lines.append(f"s.{ARRAY[self.expressions[each.carried].kind]}[{slots[each.carried]}] = {first};")
                lines.append(f"for (int round = 0; round < {loop.rounds}; ++round) {{")
            lines.append(f"part_{k}(in, numbers, s, out);")
            if k in ends:
                for each in ends[k].handed:
                    array = f"s.{ARRAY[self.expressions[each.carried].kind]}"
                    lines.append(f"{array}[{slots[each.carried]}] = {array}[{slots[each.next]}];")
                lines.append("}")
        return lines

    def _formula(self, expression: Expression, part: int) -> str:
        op, operands = expression.op, expression.operands
        if op in _INFIX:
            a, b = (self._name(i, part) for i in operands)
            return f"{a} {_INFIX[op]} {b}"
        if op == "neg":
            return f"-{self._name(operands[0], part)}"
        whole = [self._splatted(i, part) for i in operands]
        if op == "select":
            return f"{whole[0]} ? {whole[1]} : {whole[2]}"
        if op in ("max", "min"):
            return f"{op}_{'int' if expression.kind == INT else ''}({', '.join(whole)})"
        return f"{_CALLS.get(op, op + '_')}({', '.join(whole)})"

    def _name(self, index: int, part: int) -> str:
        expression = self.expressions[index]
        if expression.op == "input":
            return f"in.{ARRAY[expression.kind]}[{self.places[int(expression.value or 0)]}]"
        if expression.op == "constant" and _is_form(expression):
            return _literal(expression)
        if expression.value is not None:
            return self._number(index)
        if self.layout.part_of.get(index) == part:
            return self._named[index]
        return f"s.{ARRAY[expression.kind]}[{self.layout.slots[index]}]"

    def _number(self, index: int) -> str:
        if index not in self._number_of:
            self._number_of[index] = len(self.numbers)
            self.numbers.append(float(self.expressions[index].value or 0.0))
        return f"k[{self._number_of[index]}]"

    def _splatted(self, index: int, part: int) -> str:
        expression = self.expressions[index]
        name = self._name(index, part)
        plain = expression.value is not None and expression.op != "input"
        return f"{_SPLAT[expression.kind]}({name})" if plain else name


def _is_form(expression: Expression) -> bool:
    """Whether a constant belongs to the formula, as halves and small integers do, and is no setting."""
    value = expression.value
    return (
        expression.kind != FLOAT
        or value is None
        or (abs(value) <= _LARGEST_OF_FORM and float(2.0 * value).is_integer())
    )


def _literal(expression: Expression) -> str:
    value = expression.value
    if expression.kind == BOOL:
        return "true" if value else "false"
    if expression.kind == INT:
        return f"(INTEGER){value}"
    text = repr(float(value or 0.0))
    return {"inf": "(REAL)INFINITY", "-inf": "(REAL)-INFINITY", "nan": "(REAL)NAN"}.get(text, f"(REAL){text}")


def _settings(lanes: int, dtype: torch.dtype) -> str:
    double = dtype == torch.float64
    settings = {
        "LANES": lanes,
        "REAL": "double" if double else "float",
        "INTEGER": "long long" if double else "int",
        "ROUND": "(REAL)6755399441055744.0" if double else "(REAL)12582912.0f",
        "REACH": "1e5" if double else "5e3",
    }
    return "\n".join(f"#define {name} {value}" for name, value in settings.items())
