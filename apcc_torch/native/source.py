"""Writes a trace as a C++ program that works on several rows at once, one a lane."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files

import torch

from apcc_torch.native.driver import driver
from apcc_torch.native.layout import ARRAY, TYPE, Layout, Part, Rounds, counted, kept_as, laid_out, places
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Expression, Loop
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
_THREADS = "".join(f"#include <{name}>\n" for name in ("atomic", "chrono", "thread", "vector"))
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


def body(trace: Trace) -> Body:
    """The statements of a trace, to stand behind `prologue`."""
    layout = laid_out(trace)
    writer = _Writer(trace, layout)
    functions = [writer.part(part) for part in layout.parts]
    return Body(writer.structs(), functions, writer.calls(layout.program), writer.numbers)


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
    header = f"{_THREADS}{prologue(lanes, dtype)}\n{made.structs}"
    groups: list[list[str]] = [[] for _ in range(max(1, min(files_wanted, len(made.functions))))]
    for k, text in enumerate(made.functions):
        groups[k % len(groups)].append(text)
    groups[0].append(driver(trace, len(made.functions), made.calls, carried))
    return Source(header, ["\n".join(group) for group in groups], lanes, made.numbers)


class _Writer:
    """Writes the parts of a trace, each expression where the layout has it."""

    def __init__(self, trace: Trace, layout: Layout) -> None:
        self.layout = layout
        self.scalars = trace.scalars
        self.expressions = trace.scalars.expressions
        self.numbers: list[float] = []
        self._named = {index: f"t{k}" for k, index in enumerate(layout.part_of)}
        self._number_of: dict[int, int] = {}
        starts, self.inputs = places(trace.inputs)
        self.places = [
            start + i for leaf, start in zip(trace.inputs, starts, strict=True) for i in range(counted(leaf))
        ]
        self.targets: dict[int, list[str]] = {}
        self.plain: list[str] = []  # results that no statement computes
        last = layout.parts[-1]
        starts, self.outputs = places(trace.outputs)
        for leaf, start, row in zip(trace.outputs, starts, trace.results, strict=True):
            for k, index in enumerate(row, start):
                place = f"out.{ARRAY[kind_of(leaf.dtype)]}[{k}]"
                if index in layout.part_of:
                    self.targets.setdefault(index, []).append(place)
                else:
                    self.plain.append(f"{place} = {self._splatted(index, last)};")

    def structs(self) -> str:
        """What the parts share: their types and their names."""
        lines = []
        for name, sizes in {"Inputs": self.inputs, "Scratch": self.layout.sizes, "Outputs": self.outputs}.items():
            fields = " ".join(f"{TYPE[k]} {ARRAY[k]}[{max(n, 1)}];" for k, n in sizes.items())
            lines.append(f"struct {name} {{ {fields} }};")
        lines += [f"{_SIGNATURE.format(part.number)};" for part in self.layout.parts]
        return "\n".join(lines)

    def calls(self, program: list[Part | Rounds]) -> list[str]:
        """The parts in the order in which they run."""
        lines = []
        for item in program:
            if isinstance(item, Part):
                lines.append(f"part_{item.number}(in, numbers, s, out);")
                continue
            loop = self.scalars.loops[item.loop]
            more = f"any(s.b[{self.layout.slots[loop.variables[loop.going or 0]]}])"
            lines.append(f"for (int n{item.loop} = 0; n{item.loop} < {loop.times} && {more}; ++n{item.loop}) {{")
            lines += [f"    {line}" for line in self.calls(item.body)]
            lines.append("}")
        return lines

    def part(self, part: Part) -> str:
        """One function: its share of the statements."""
        lines = [f"__attribute__((noinline)) {_SIGNATURE.format(part.number)} {{"]
        for index in part.statements:
            expression = self.expressions[index]
            name = self._named[index]
            lines.append(f"const {TYPE[expression.kind]} {name} = {self._formula(expression, part)};")
            if index in self.layout.slots:
                lines.append(f"{self._slot(index)} = {name};")
            lines += [f"{place} = {name};" for place in self.targets.get(index, ())]
        for number in part.begins:
            loop = self.scalars.loops[number]
            lines += self._handed_on(number, loop, loop.initial, part)
        if part.carries is not None:
            loop = self.scalars.loops[part.carries]
            lines += self._handed_on(part.carries, loop, loop.results, part)
        if part is self.layout.parts[-1]:
            lines += self.plain
        return "\n".join((*lines, "}"))

    def _handed_on(self, number: int, loop: Loop, values: list[int], part: Part) -> list[str]:
        """A loop's state becomes these values: all are read before one is written."""
        read, written = [], []
        for k in self.layout.places[number]:
            if values[k] != loop.variables[k]:
                kind = self.expressions[loop.variables[k]].kind
                read.append(f"const {TYPE[kind]} next{number}_{k} = {self._splatted(values[k], part)};")
                written.append(f"{self._slot(loop.variables[k])} = next{number}_{k};")
        return read + written

    def _slot(self, index: int) -> str:
        return f"s.{ARRAY[self.expressions[index].kind]}[{self.layout.slots[index]}]"

    def _formula(self, expression: Expression, part: Part) -> str:
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

    def _name(self, index: int, part: Part) -> str:
        expression = self.expressions[index]
        if expression.op == "input":
            return f"in.{ARRAY[expression.kind]}[{self.places[int(expression.value or 0)]}]"
        if expression.op == "constant" and _is_form(expression):
            return _literal(expression)
        if expression.value is not None:
            return self._number(index)
        if index not in self.scalars.entry_of and self.layout.part_of[index] is part:
            return self._named[index]
        return self._slot(kept_as(self.scalars, index))

    def _number(self, index: int) -> str:
        if index not in self._number_of:
            self._number_of[index] = len(self.numbers)
            self.numbers.append(float(self.expressions[index].value or 0.0))
        return f"k[{self._number_of[index]}]"

    def _splatted(self, index: int, part: Part) -> str:
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
