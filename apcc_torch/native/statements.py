"""Writes a trace as C++ statements."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.native.alike import INPUTS, NUMBERS, OUTPUTS, SCRATCH, Places, evenly, shared
from apcc_torch.native.layout import ARRAY, TYPE, Layout, Move, Part, Row, Runs, kept_as, laid_out, places
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Expression, Loop
from apcc_torch.native.series import Series
from apcc_torch.native.slots import slots
from apcc_torch.native.trace import Trace
from apcc_torch.native.values import kind_of

_SPLAT = {FLOAT: "splat", INT: "splat_int", BOOL: "splat_bool"}
_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|",
    "lt": "<", "le": "<=", "eq": "==", "ne": "!=",
}  # fmt: skip
_SIGNATURE = (
    f"void part_{{}}([[maybe_unused]] const Inputs& {INPUTS}, [[maybe_unused]] const REAL* __restrict {NUMBERS}, "
    f"[[maybe_unused]] Scratch& {SCRATCH}, [[maybe_unused]] Outputs& {OUTPUTS})"
)
_LARGEST_OF_FORM = 16.0
# The functions of lanes.hpp whose names differ from the operation's with an underscore behind it.
_CALLS = {"float": "real", "int": "integer"}


@dataclass
class Body:
    """The statements of a trace.

    structs: The types Inputs, Scratch and Outputs, and the functions' declarations.
    functions: Each its share of the statements.
    calls: What runs them, with `in`, `numbers`, `s` and `out` at hand.
    numbers: The expressions whose values they read in place of constants.
    """

    structs: str
    functions: list[str]
    calls: list[str]
    numbers: list[int]


def body(trace: Trace, together: bool = True) -> Body:
    """The statements of a trace, to stand behind `prologue`.

    Args:
        trace: From `traced`.
        together: See `laid_out`.
    """
    layout = laid_out(trace, together)
    writer = _Writer(trace, layout)
    functions = [writer.part(part) for part in layout.parts]
    return Body(writer.structs(), functions, writer.calls(layout.program), writer.numbers)


class _Writer:
    """Writes the parts of a trace, each expression where the layout has it."""

    def __init__(self, trace: Trace, layout: Layout) -> None:
        self.layout = layout
        self.slots = slots(layout, trace)
        self.scalars = trace.scalars
        self.expressions = trace.scalars.expressions
        self.numbers: list[int] = []
        self._named = {index: f"t{k}" for k, index in enumerate(layout.part_of)}
        self._number_of: dict[int, int] = {}
        self.tables: dict[Places, int] = {}
        self._row_of: dict[Places, int] = {}
        self.inputs = places(trace.inputs)[1]
        self.targets: dict[int, list[str]] = {}
        self.plain: list[str] = []  # results that no statement computes
        last = layout.parts[-1]
        starts, self.outputs = places(trace.outputs)
        for leaf, start, row in zip(trace.outputs, starts, trace.results, strict=True):
            for k, index in enumerate(row, start):
                place = _at(OUTPUTS, kind_of(leaf.dtype), k)
                if index in layout.part_of and index not in layout.in_formula:
                    self.targets.setdefault(index, []).append(place)
                else:
                    self.plain.append(f"{place} = {self._splatted(index, last)};")

    def structs(self) -> str:
        """What the parts share: their types and their names."""
        lines = []
        for name, sizes in {"Inputs": self.inputs, "Scratch": self.slots.sizes, "Outputs": self.outputs}.items():
            fields = " ".join(f"{TYPE[k]} {ARRAY[k]}[{max(n, 1)}];" for k, n in sizes.items())
            lines.append(f"struct {name} {{ {fields} }};")
        lines += [f"{_SIGNATURE.format(part.number)};" for part in self.layout.parts]
        for table, number in self.tables.items():
            width = "short" if max(table) < 1 << 16 else "int"
            lines.append(f"static const unsigned {width} table_{number}[] = {{{', '.join(map(str, table))}}};")
        return "\n".join(lines)

    def calls(self, program: list[Part | Runs]) -> list[str]:
        """The parts in the order in which they run."""
        lines = []
        for item in program:
            if isinstance(item, Part):
                lines.append(f"part_{item.number}({INPUTS}, numbers, {SCRATCH}, {OUTPUTS});")
                continue
            loop = self.scalars.loops[item.loop]
            if loop.calls:
                lines += self.calls(item.body)
                continue
            more = f"any({self._slot(loop.variables[loop.going or 0])})"
            lines.append(f"for (int n{item.loop} = 0; n{item.loop} < {loop.times} && {more}; ++n{item.loop}) {{")
            lines += [f"    {line}" for line in self.calls(item.body)]
            lines.append("}")
        return lines

    def part(self, part: Part) -> str:
        """One function: its share of the statements."""
        lines = [f"__attribute__((noinline)) {_SIGNATURE.format(part.number)} {{"]
        self._handed_early(part)
        for statement in part.statements:
            if isinstance(statement, Series):
                lines += self._series(statement, part)
            elif isinstance(statement, Move):
                lines.append(
                    f"{self._in_row(statement.row, statement.place)} = {self._splatted(statement.what, part)};"
                )
            else:
                lines += self._single(statement, part)
        for number, call in part.begins:
            loop = self.scalars.loops[number]
            lines += self._handed_on(number, loop, loop.begun(call), part)
        if part.carries is not None:
            loop = self.scalars.loops[part.carries]
            lines += self._handed_on(part.carries, loop, loop.results, part)
        if part is self.layout.parts[-1]:
            lines += self.plain
        return "\n".join((*lines, "}"))

    def _single(self, index: int, part: Part) -> list[str]:
        """An expression by itself, and where it goes."""
        rows = [self._in_row(row, place) for row, place in self.layout.moved.get(index, ())]
        expression, name = self.expressions[index], self._named[index]
        if index in self.scalars.returned_of:
            back = self.scalars.returned_of[index]
            formula = self._slot(self.scalars.loops[back.routine].variables[back.place])
        else:
            formula = self._formula(expression, [self._written(i, part) for i in expression.operands])
        targets = [*self.targets.get(index, ())]
        if index in self.slots.left:
            return [f"{target} = {formula};" for target in [*targets, *rows]]
        if index in self.slots.of:
            targets.append(self._slot(index))
        targets += rows
        return [f"const {TYPE[expression.kind]} {name} = {formula};", *(f"{target} = {name};" for target in targets)]

    def _series(self, series: Series, part: Part) -> list[str]:
        """A loop over slices."""
        made = {formula.results for formula in series.formulas}
        lines = [f"for (long n = 0; n < {series.length}; ++n) {{"]
        for formula in series.formulas:
            first = formula.results[0]
            expression, name = self.expressions[first], self._named[first]
            operands = [
                (self._named[o[0]], self._named[o[0]]) if o in made else self._in_slice(o, part)
                for o in formula.operands
            ]
            lines.append(f"    const {TYPE[expression.kind]} {name} = {self._formula(expression, operands)};")
            if first in self.slots.of:
                lines.append(f"    {_at(SCRATCH, expression.kind, f'{self.slots.of[first]} + n')} = {name};")
        return [*lines, "}"]

    def _in_slice(self, operand: Places, part: Part) -> tuple[str, str]:
        """An operand of a series, as `_written`: what slice n has."""
        if shared(operand):
            return self._written(operand[0], part)
        expression = self.expressions[operand[0]]
        row = self.layout.row(part, operand)
        if row is None and expression.op != "input" and expression.value is not None:
            name = f"{NUMBERS}[{self._numbers(operand)} + n]"
            return name, f"{_SPLAT[expression.kind]}({name})"
        if row is not None:
            name = _at(SCRATCH, expression.kind, f"{self.slots.of[row]} + n")
        elif expression.op == "input":
            name = _at(INPUTS, expression.kind, self._along([int(self.expressions[i].value or 0) for i in operand]))
        else:
            slots_of_them = [self.slots.of[kept_as(self.scalars, i)] for i in operand]
            name = _at(SCRATCH, expression.kind, self._along(slots_of_them))
        return name, name

    def _along(self, numbers: list[int]) -> str:
        """The nth of these numbers."""
        first, step = numbers[0], numbers[1] - numbers[0]
        if evenly(numbers):
            return f"{first} + n" if step == 1 else f"{first} + {step} * n"
        table = tuple(number - min(numbers) for number in numbers)
        return f"{min(numbers)} + table_{self.tables.setdefault(table, len(self.tables))}[n]"

    def _in_row(self, row: Row, place: int) -> str:
        return _at(SCRATCH, self.expressions[row.places[0]].kind, self.slots.of[row] + place)

    def _handed_on(self, number: int, loop: Loop, values: list[int], part: Part) -> list[str]:
        """A loop's state becomes these values: all are read before one is written."""
        read, written = [], []
        for k in self.layout.places[number]:
            if k < len(values) and values[k] != loop.variables[k]:
                kind, target = self.expressions[loop.variables[k]].kind, self._slot(loop.variables[k])
                if not loop.calls:
                    read.append(f"const {TYPE[kind]} next{number}_{k} = {self._splatted(values[k], part)};")
                    written.append(f"{target} = next{number}_{k};")
                elif target not in self.targets.get(values[k], ()) and target != self._name(values[k], part):
                    # What a routine is handed and what it comes to lie apart: nothing is overwritten that is read.
                    written.append(f"{target} = {self._splatted(values[k], part)};")
        return read + written

    def _handed_early(self, part: Part) -> None:
        """Has what a part hands to routines put there as soon as it is computed, while it is at hand."""
        for number, call in part.begins:
            loop = self.scalars.loops[number]
            if call is not None:
                for k in self.layout.places[number]:
                    given = loop.calls[call]
                    if k < len(given) and self._computed(given[k], part):
                        self.targets.setdefault(given[k], []).append(self._slot(loop.variables[k]))

    def _computed(self, index: int, part: Part) -> bool:
        """Whether a part has this statement by itself."""
        apart = index in self.scalars.entry_of or index in self.layout.in_formula or index in self.slots.left
        return not apart and self.layout.part_of.get(index) is part

    def _slot(self, index: int) -> str:
        return _at(SCRATCH, self.expressions[index].kind, self.slots.of[index])

    def _written(self, index: int, part: Part) -> tuple[str, str]:
        """An operand as it stands beside others, and as it stands alone, where a number has to fill all lanes."""
        expression, name = self.expressions[index], self._name(index, part)
        plain = expression.value is not None and expression.op != "input"
        return name, f"{_SPLAT[expression.kind]}({name})" if plain else name

    def _formula(self, expression: Expression, operands: list[tuple[str, str]]) -> str:
        op = expression.op
        if op in _INFIX:
            return f"{operands[0][0]} {_INFIX[op]} {operands[1][0]}"
        if op == "neg":
            return f"-{operands[0][0]}"
        whole = [alone for _, alone in operands]
        if op == "select":
            return f"{whole[0]} ? {whole[1]} : {whole[2]}"
        if op in ("max", "min"):
            return f"{op}_{'int' if expression.kind == INT else ''}({', '.join(whole)})"
        return f"{_CALLS.get(op, op + '_')}({', '.join(whole)})"

    def _name(self, index: int, part: Part) -> str:
        expression = self.expressions[index]
        if expression.op == "input":
            return _at(INPUTS, expression.kind, int(expression.value or 0))
        if expression.op == "constant" and is_form(expression):
            return _literal(expression)
        if expression.value is not None:
            return self._number(index)
        if self._computed(index, part):
            return self._named[index]
        return self._slot(kept_as(self.scalars, index))

    def _number(self, index: int) -> str:
        if index not in self._number_of:
            self._number_of[index] = len(self.numbers)
            self.numbers.append(index)
        return f"{NUMBERS}[{self._number_of[index]}]"

    def _numbers(self, places: Places) -> int:
        """Where the numbers of a row begin."""
        if places not in self._row_of:
            self._row_of[places] = len(self.numbers)
            self.numbers += places
        return self._row_of[places]

    def _splatted(self, index: int, part: Part) -> str:
        return self._written(index, part)[1]


def _at(memory: str, kind: str, place: int | str) -> str:
    """A place of a memory, in its array of one kind."""
    return f"{memory}.{ARRAY[kind]}[{place}]"


def is_form(expression: Expression) -> bool:
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
