"""Where the values of a program are kept: slots of its memory for those that other statements read from there."""

from __future__ import annotations

from dataclasses import dataclass, field

from apcc_torch.native.layout import Layout, Move, Part, Row, Statement, kept_as, outside
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Scalars
from apcc_torch.native.series import Series
from apcc_torch.native.trace import Trace

Kept = int | Row
"""What has slots: an expression, or a row."""


@dataclass
class Slots:
    """The memory of a program.

    of: Of an expression its slot among those of its kind, of a row its first.
    sizes: How many slots there are of each kind.
    left: What routines came to that is read from where they left it, for they are not called before it is read last.
    """

    of: dict[Kept, int] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=lambda: {FLOAT: 1, INT: 1, BOOL: 1})
    left: set[int] = field(default_factory=set)


def slots(layout: Layout, trace: Trace) -> Slots:
    """Slots for what is read by another part than the one that computes it, and for what series read and compute."""
    allocation = _Allocation(layout, trace.scalars, _Uses(layout, trace).last())
    allocation.run()
    return allocation.slots


class _Uses:
    """When each expression and row is needed last; what a loop needs from before, it needs to its end."""

    def __init__(self, layout: Layout, trace: Trace) -> None:
        self.layout = layout
        self.trace = trace
        self._last: dict[Kept, int] = {}

    def last(self) -> dict[Kept, int]:
        """When each is read from memory for the last time."""
        layout, scalars = self.layout, self.trace.scalars
        for part in layout.parts:
            for time, statement in enumerate(part.statements, part.first):
                self._statement(statement, part, time)
            for loop, call in part.begins:
                given = scalars.loops[loop].begun(call)
                for k in layout.places[loop]:
                    if k < len(given):
                        self._used(given[k], part, part.end)
            if part.carries is not None:
                for k in layout.places[part.carries]:
                    self._used(scalars.loops[part.carries].results[k], part, part.end)
                    self._used(scalars.loops[part.carries].variables[k], part, part.end)
        last = layout.parts[-1]
        for row in self.trace.results:
            for index in row:
                if index in scalars.entry_of or index in layout.in_formula:
                    self._used(index, last, last.end)
        return self._last

    def _statement(self, statement: Statement, part: Part, time: int) -> None:
        if isinstance(statement, Move):
            self._used(statement.what, part, time)
        elif isinstance(statement, Series):
            for operand in outside(statement):
                row = self.layout.row(part, operand)
                if row is not None:
                    self._until(row, time)
                else:
                    for index in operand:
                        self._used(index, part, time)
        else:
            for operand_index in self.trace.scalars[statement].operands:
                self._used(operand_index, part, time)

    def _used(self, index: int, part: Part, time: int) -> None:
        keeper = kept_as(self.trace.scalars, index)
        home = self.layout.part_of.get(keeper)
        if home is None:
            return
        deeper = part.path[len(home.path) :]
        self._until(keeper, self.layout.until(deeper[0]) if deeper else time)

    def _until(self, kept: Kept, time: int) -> None:
        self._last[kept] = max(time, self._last.get(kept, 0))


class _Allocation:
    """Gives a slot to each value that is read from memory; slots are used again when their last reader is done."""

    def __init__(self, layout: Layout, scalars: Scalars, last: dict[Kept, int]) -> None:
        self.layout = layout
        self.scalars = scalars
        self.last = last
        self.slots = Slots()
        # By routine: what it computes is in memory of its own, whoever calls it.
        self.free: dict[tuple[int | None, str, int], list[int]] = {}
        self.ending: dict[int, list[tuple[tuple[int | None, str, int], int]]] = {}
        self.within: int | None = None
        # What a routine comes to lies where its callers read it.
        self.outcome = {
            (number, loop.results[k]): loop.variables[k]
            for number, loop in enumerate(scalars.loops)
            if loop.calls
            for k in layout.places.get(number, ())
            if k >= len(loop.calls[0])
        }

    def run(self) -> None:
        loops = self.scalars.loops
        for part in self.layout.parts:
            self.within = next((loop for loop in reversed(part.path) if loops[loop].calls), None)
            for time, statement in enumerate(part.statements, part.first):
                self._release(time)
                self._statement(statement, part, time)
            self._release(part.end)
            for loop, _ in part.begins:
                for variable in (loops[loop].variables[k] for k in self.layout.places[loop]):
                    if not loops[loop].calls:
                        self._place(variable, part.end)
                    elif variable not in self.slots.of:  # a later call finds it where it is
                        kind = self.scalars[variable].kind
                        self.slots.of[variable] = self._fresh((loop, kind, 1))

    def _release(self, time: int) -> None:
        """Frees what was read for the last time before."""
        for whose, slot in self.ending.pop(time - 1, ()):
            self.free.setdefault(whose, []).append(slot)

    def _statement(self, statement: Statement, part: Part, time: int) -> None:
        if isinstance(statement, Move):
            self._row(statement.row)
        elif isinstance(statement, Series):
            for formula in statement.formulas:
                until = max(self.last.get(index, time) for index in formula.results)
                if until > time:
                    kind, size = self.scalars[formula.results[0]].kind, len(formula.results)
                    slot = self._slot(kind, size, until)
                    self.slots.of |= {index: slot + k for k, index in enumerate(formula.results)}
        else:
            for row, _ in self.layout.moved.get(statement, ()):
                self._row(row)
            back, own = self.scalars.returned_of.get(statement), (part.path[-1] if part.path else None, statement)
            if back is not None and self.last.get(statement, time) <= self.layout.overwritten(back):
                self.slots.of[statement] = self.slots.of[self.scalars.loops[back.routine].variables[back.place]]
                self.slots.left.add(statement)
            elif back is None and own in self.outcome:
                self.slots.of[statement] = self.slots.of[self.outcome[own]]
            elif statement in self.layout.read or self.last.get(statement, time) > part.end:
                self._place(statement, time)

    def _row(self, row: Row) -> None:
        if row not in self.slots.of:
            kind = self.scalars[row.places[0]].kind
            self.slots.of[row] = self._slot(kind, len(row.places), self.last[row])

    def _place(self, index: int, time: int) -> None:
        self.slots.of[index] = self._slot(self.scalars[index].kind, 1, self.last.get(index, time))

    def _slot(self, kind: str, size: int, until: int) -> int:
        whose = self.within, kind, size
        self.ending.setdefault(until, []).append((whose, slot := self._fresh(whose)))
        return slot

    def _fresh(self, whose: tuple[int | None, str, int]) -> int:
        _, kind, size = whose
        free = self.free.get(whose)
        if free:
            return free.pop()
        slot = self.slots.sizes[kind]
        self.slots.sizes[kind] += size
        return slot
