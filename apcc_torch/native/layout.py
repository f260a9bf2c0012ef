"""A program in parts: where each of its expressions is computed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

import torch

from apcc_torch.native.alike import Places, memory, numbers, shared
from apcc_torch.native.ordering import ordered
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Returned, Scalars
from apcc_torch.native.series import Items, Rounds, Series, in_series, one_by_one
from apcc_torch.native.trace import Leaf, Trace
from apcc_torch.native.values import kind_of

# A function of this many statements is still compiled in a time that grows in proportion.
STATEMENTS = 700
ARRAY = {FLOAT: "v", INT: "i", BOOL: "b"}
TYPE = {FLOAT: "V", INT: "I", BOOL: "B"}


def counted(leaf: Leaf) -> int:
    """How many entries a tensor has."""
    return int(torch.Size(leaf.shape).numel())


def places(leaves: list[Leaf]) -> tuple[list[int], dict[str, int]]:
    """For each tensor where its entries begin among those of their kind, and how many there are of each kind."""
    counts = {FLOAT: 0, INT: 0, BOOL: 0}
    starts = []
    for leaf in leaves:
        starts.append(counts[kind_of(leaf.dtype)])
        counts[kind_of(leaf.dtype)] += counted(leaf)
    return starts, counts


class Row(NamedTuple):
    """Values of several expressions side by side, as a series reads them; of one block, whose loops are `path`."""

    path: tuple[int, ...]
    places: Places


class Move(NamedTuple):
    """A value that is put into its place in a row."""

    what: int
    row: Row
    place: int


Statement = int | Series | Move


@dataclass
class Part:
    """A function of the program.

    number: In the order of the program. path: The loops in which it runs, the outermost first.
    statements: What it does. first: When it does the first of them; each takes one time.
    begins: Loops whose state it sets at its end, as they begin, and routines with the number of the call.
    carries: The loop whose round ends with it.
    """

    number: int
    path: tuple[int, ...]
    statements: list[Statement] = field(default_factory=list)
    begins: list[tuple[int, int | None]] = field(default_factory=list)
    carries: int | None = None
    size: int = 0
    first: int = 0

    @property
    def end(self) -> int:
        """When it is done."""
        return self.first + len(self.statements)


@dataclass
class Runs:
    """Parts of a program that are run again and again, or of a routine that is called here."""

    loop: int
    body: list[Part | Runs]


@dataclass
class Layout:
    """A program in parts.

    places: Of each loop which scalars of its state count.
    bodies: Of each loop and routine its parts.
    ends: Of each loop the part with which a round ends.
    begun: Of each loop the part that begins it, of a routine those that do, in order, and `calls` the calls.
    part_of: Of each expression, and of what stands for a loop's state, the part that computes it.
    in_formula: Of what a series computes the number of its formula, and the slice.
    rows: What series read that is in no one memory otherwise.
    moved: Of an expression the rows that it is put into as soon as it is there, and where in each.
    read: What series read from where it is, so that it has to be in memory.
    """

    places: dict[int, list[int]]
    program: list[Part | Runs] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    bodies: dict[int, list[Part | Runs]] = field(default_factory=dict)
    ends: dict[int, Part] = field(default_factory=dict)
    begun: dict[int, list[Part]] = field(default_factory=dict)
    calls: dict[int, list[int | None]] = field(default_factory=dict)
    part_of: dict[int, Part] = field(default_factory=dict)
    in_formula: dict[int, tuple[int, int]] = field(default_factory=dict)
    rows: set[Row] = field(default_factory=set)
    moved: dict[int, list[tuple[Row, int]]] = field(default_factory=dict)
    read: set[int] = field(default_factory=set)

    def operations(self, scalars: Scalars) -> int:
        """How many a row takes at most."""
        total = 0
        for part in self.parts:
            rounds = 1
            for loop in part.path:
                rounds *= scalars.loops[loop].times * len(self.begun[loop])
            total += rounds * sum(_work(statement) for statement in part.statements)
        return total

    def until(self, loop: int) -> int:
        """When it has run for the last time."""
        return max(self.ends[loop].end, self.begun[loop][-1].end)

    def overwritten(self, back: Returned) -> float:
        """When the next call begins to overwrite what this one came to."""
        later = self.begun[back.routine][self.calls[back.routine].index(back.call) + 1 :]
        return later[0].end if later else inf

    def row(self, part: Part, operand: Places) -> Row | None:
        """The row that a series in a part reads an operand from, None where it is read from where it is."""
        row = Row(part.path, operand)
        return row if row in self.rows else None


def kept_as(scalars: Scalars, index: int) -> int:
    """The expression in whose slot the value of this one is: a loop's outcome is where its variable was."""
    entry = scalars.entry_of.get(index)
    return index if entry is None else scalars.loops[entry.loop].variables[entry.place]


def laid_out(trace: Trace, together: bool = True) -> Layout:
    """Only what the results need, in an order that keeps an operand near its use.

    Args:
        trace: What is computed.
        together: What is alike on several slices is written once, in a loop over them.
    """
    scalars = trace.scalars
    block, needed = ordered(scalars, [index for row in trace.results for index in row])
    items = in_series(trace, block, STATEMENTS) if together else one_by_one(block)
    layout = Layout(needed)
    layout.program = _Division(layout, scalars).divided(items, ())
    if not isinstance(layout.program[-1], Part):
        layout.program.append(_part(layout, ()))
    time = 0
    for part in layout.parts:
        part.first, time = time, time + len(part.statements) + 1
    return layout


def _work(statement: Statement) -> int:
    if isinstance(statement, Series):
        return statement.length * len(statement.formulas)
    return 1 if isinstance(statement, int) else 0


def _part(layout: Layout, path: tuple[int, ...]) -> Part:
    part = Part(len(layout.parts), path)
    layout.parts.append(part)
    return part


def outside(series: Series) -> Iterator[Places]:
    """The operands of a series that it does not make itself."""
    made = {formula.results for formula in series.formulas}
    for formula in series.formulas:
        yield from (operand for operand in formula.operands if operand not in made)


class _Division:
    """Divides a program into parts that a compiler takes well; a loop's body begins and ends with a part."""

    def __init__(self, layout: Layout, scalars: Scalars) -> None:
        self.layout = layout
        self.scalars = scalars
        self.formulas = 0

    def divided(self, items: Items, path: tuple[int, ...]) -> list[Part | Runs]:
        """A block's parts, in order."""
        layout = self.layout
        pieces: list[Part | Runs] = [part := _part(layout, path)]
        for item in items:
            if isinstance(item, Rounds):
                part.begins.append((item.loop, item.call))
                layout.begun.setdefault(item.loop, []).append(part)
                layout.calls.setdefault(item.loop, []).append(item.call)
                if item.body is not None:
                    variables = self.scalars.loops[item.loop].variables
                    layout.part_of.update((variables[k], part) for k in layout.places[item.loop])
                    self._body(item.loop, item.body, (*path, item.loop))
                pieces += [Runs(item.loop, layout.bodies[item.loop]), part := _part(layout, path)]
                continue
            size = 1 if isinstance(item, int) else len(item.formulas)
            if part.statements and part.size + size > STATEMENTS:
                pieces.append(part := _part(layout, path))
            part.size += size
            if isinstance(item, int):
                layout.part_of[item] = part
            else:
                self._series(item, part)
            part.statements.append(item)
        return pieces

    def _body(self, loop: int, items: Items, path: tuple[int, ...]) -> None:
        """Divides what a loop or a routine does."""
        layout = self.layout
        layout.bodies[loop] = inner = self.divided(items, path)
        last = inner[-1]
        if not isinstance(last, Part):
            inner.append(last := _part(layout, path))
        last.carries = loop
        layout.ends[loop] = last

    def _series(self, series: Series, part: Part) -> None:
        """Has what a series reads in no one memory moved into a row before it."""
        layout = self.layout
        for operand in outside(series):
            row = Row(part.path, operand)
            if shared(operand) or row in layout.rows or numbers(self.scalars, operand):
                continue
            if len(where := {memory(self.scalars, index) for index in operand}) == 1 and None not in where:
                layout.read.update(operand)
                continue
            layout.rows.add(row)
            for place, index in enumerate(operand):
                home = layout.part_of.get(index)
                if home is not None and home.path == part.path and index not in layout.in_formula:
                    layout.moved.setdefault(index, []).append((row, place))
                else:
                    part.statements.append(Move(index, row, place))
        for formula in series.formulas:
            for place, index in enumerate(formula.results):
                layout.part_of[index] = part
                layout.in_formula[index] = self.formulas, place
            self.formulas += 1
