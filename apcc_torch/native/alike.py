"""What a tensor operation does alike on each slice of its result, so that it can be written once for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import NamedTuple

from torch import Tensor

from apcc_torch.native.scalars import COMMUTATIVE, FLOAT, Scalars

Places = tuple[int, ...]
"""Expressions, one of each slice."""

# What costs how much text, in statements of one operation: a value that is put where a loop finds it is one without an
# operation, and a table of where values are is a declaration, with a short number for each of its entries. These are
# estimates, not fits: half as large they make 7 % less text of the paper's step, twice as large 19 % more.
MOVED = 0.5
TABLE, ENTRY = 0.4, 0.15
WORTH = 0.9
"""A tensor operation is written once where that leaves less than this share of its statements."""

INPUTS, SCRATCH, OUTPUTS, NUMBERS = "in", "s", "out", "k"
"""What a program calls its memories: arguments, what it keeps, results, and constants."""


class Call(NamedTuple):
    """A tensor operation that was noted.

    first, last: The expressions that it made, first <= index < last. result: Those of its (first) result's entries.
    """

    first: int
    last: int
    result: Tensor


class Formula(NamedTuple):
    """One scalar operation on each of several slices.

    results: What it makes. operands: Of each operand what it is; where all are one expression, the slices share it.
    """

    results: Places
    operands: tuple[Places, ...]


def shared(places: Places) -> bool:
    """Whether all slices have the same expression."""
    return places.count(places[0]) == len(places)


def formulas(scalars: Scalars, calls: list[Call], blocks: list[int]) -> list[Formula]:
    """What the calls do alike on slices.

    Each expression is of one formula at most, and slices do not depend on each other within a call.

    Args:
        scalars: The expressions.
        calls: In the order in which they were noted.
        blocks: Of each expression the stretch of the program that computes it, negative for none. Only what is of one
            stretch is put together.
    """
    found: list[Formula] = []
    place_of: dict[int, tuple[int, int]] = {}
    tables: set[Places] = set()
    for call in calls:
        count = sum(blocks[index] >= 0 for index in range(call.first, call.last))
        if count < 2:
            continue
        better: list[_Attempt] = []
        for slices in _slices(call.result):
            bound = better[-1].cost if better else WORTH * count
            if count >= bound * len(slices[0]):  # of n slices at least an nth is left
                continue
            attempt = _Attempt(scalars, call, blocks, place_of, tables)
            if attempt.match(slices, count, bound):
                better.append(attempt)
        best = next((attempt for attempt in reversed(better) if attempt.in_order()), None)
        if best is None:
            continue
        tables = best.tables
        for formula in best.made.values():
            for place, index in enumerate(formula.results):
                place_of[index] = (len(found), place)
            found.append(formula)
    return found


def _slices(result: Tensor) -> list[list[Places]]:
    """Ways of taking a result apart: along a dimension, or along the leading ones together; each a list of entries."""
    shape = result.shape
    ways = [result.reshape(shape[:k].numel(), -1) for k in range(len(shape), 1, -1)]
    for k, n in enumerate(shape):
        along = result.movedim(k, 0).reshape(n, -1)
        ways.append(along)
        # Sections of several coordinates each, or coordinates of several sections.
        for m in range(2, n // 2 + 1):
            if n % m == 0:
                ways.append(along.reshape(n // m, -1))
                ways.append(along.reshape(n // m, m, -1).movedim(1, 0).reshape(m, -1))
    return [[tuple(entry) for entry in way.mT.tolist()] for way in ways if way.shape[0] > 1]


class _Attempt:
    """One way of taking a call apart."""

    def __init__(
        self,
        scalars: Scalars,
        call: Call,
        blocks: list[int],
        place_of: dict[int, tuple[int, int]],
        tables: set[Places],
    ) -> None:
        self.scalars = scalars
        self.call = call
        self.blocks = blocks
        self.place_of = place_of
        self.tables = set(tables)
        self.made: dict[Places, Formula] = {}
        self.cost = 0.0
        self._taken: set[int] = set()
        self._moved: set[Places] = set()

    def match(self, entries: list[Places], count: int, best: float) -> bool:
        """Goes from the entries of the result to what they are made of, as far as slices are alike.

        Args:
            entries: Of the result.
            count: Statements of the call when nothing is put together.
            best: The cost that has to be undercut.

        Returns:
            Whether it is.
        """
        stack = list(reversed(entries))
        while stack:
            if self.cost + len(self.made) >= best:
                return False
            places = stack.pop()
            if shared(places) or places in self.made:
                continue
            if not self._alike(places):
                self._move(places)
                continue
            self._taken.update(places)
            formula = Formula(places, self._operands(places))
            self.made[places] = formula
            stack.extend(reversed(formula.operands))
        self.cost += len(self.made) + count - len(self._taken)
        return self.cost < best

    def in_order(self) -> bool:
        """Whether the formulas can be computed one after the other: equal expressions of two slices are one."""
        node_of = {index: formula.results for formula in self.made.values() for index in formula.results}
        graph: dict[Places, set[Places]] = {}
        for index in range(self.call.first, self.call.last):
            if self.blocks[index] >= 0:
                needed = graph.setdefault(node_of.get(index, (index,)), set())
                inside = (i for i in self.scalars[index].operands if self.call.first <= i < self.call.last)
                needed.update(node_of.get(i, (i,)) for i in inside)
        try:
            TopologicalSorter(graph).prepare()
        except CycleError:
            return False
        return True

    def _alike(self, places: Places) -> bool:
        first, last = self.call.first, self.call.last
        block = self.blocks[places[0]]
        if block < 0 or len(set(places)) < len(places):
            return False
        like = self.scalars[places[0]]
        for index in places:
            if not first <= index < last or index in self._taken or self.blocks[index] != block:
                return False
            this = self.scalars[index]
            if this.op != like.op or this.kind != like.kind or not this.operands or this.value is not None:
                return False
        return True

    def _operands(self, places: Places) -> tuple[Places, ...]:
        of_each = [self.scalars[index].operands for index in places]
        if self.scalars[places[0]].op in COMMUTATIVE:
            like = of_each[0]
            family = self._family(like[0])
            of_each = [self._turned(these, like, family) for these in of_each]
        return tuple(zip(*of_each, strict=True))

    def _turned(self, these: tuple[int, ...], like: tuple[int, ...], family: tuple[int | str, ...]) -> tuple[int, ...]:
        """Operands in the order that is more like another's, whose first is of this family."""
        if these[0] == like[0] or these[1] == like[1]:
            return these
        other = these[::-1]
        if other[0] == like[0] or other[1] == like[1] or self._family(these[0]) != family == self._family(other[0]):
            return other
        return these

    def _family(self, index: int) -> tuple[int | str, ...]:
        if index in self.place_of:
            return "formula", self.place_of[index][0]
        inside = self.call.first <= index < self.call.last
        return (self.scalars[index].op, inside)

    def _move(self, places: Places) -> None:
        """Counts what it costs to read these."""
        if places in self._moved:
            return
        self._moved.add(places)
        if numbers(self.scalars, places):
            return
        where_from = {memory(self.scalars, index) for index in places}
        if len(where_from) > 1 or None in where_from:
            self.cost += MOVED * len(places)
            return
        alone = sum(self.scalars[index].op != "input" and index not in self.place_of for index in places)
        where = [self.place_of.get(index, (-1, index)) for index in places]
        steps = tuple(place - where[0][1] for _, place in where)
        one = alone == 0 and len({formula for formula, _ in where}) == 1
        if one and evenly(steps):
            return
        self.cost += TABLE + MOVED * alone
        if not (one and steps in self.tables):
            self.cost += ENTRY * len(places)
            if one:
                self.tables.add(steps)


def numbers(scalars: Scalars, places: Places) -> bool:
    """Whether all are numbers that a program reads from a list."""
    return scalars[places[0]].kind == FLOAT and all(scalars.known(index) is not None for index in places)


def memory(scalars: Scalars, index: int) -> str | None:
    """The memory that an expression is read from; None of a number."""
    if scalars.known(index) is not None:
        return None
    return INPUTS if scalars[index].op == "input" else SCRATCH


def evenly(numbers: Sequence[int]) -> bool:
    """Whether numbers are at equal distances."""
    return all(b - a == numbers[1] - numbers[0] for a, b in pairwise(numbers))
