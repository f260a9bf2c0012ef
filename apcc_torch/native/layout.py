"""Where the expressions of a program are computed and kept: in which part, and in which slot between parts."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from apcc_torch.native.ordering import Block, Run, ordered
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Scalars
from apcc_torch.native.trace import Leaf, Trace
from apcc_torch.native.values import kind_of

# A function of this many statements is still compiled in a time that grows in proportion.
STATEMENTS = 1500
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


@dataclass
class Part:
    """A function of the program.

    number: In the order of the program. path: The loops in which it runs, the outermost first.
    statements: Expressions that it computes.
    begins: Loops whose state it sets at its end, as they begin. carries: The loop whose round ends with it.
    """

    number: int
    path: tuple[int, ...]
    statements: list[int] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)
    carries: int | None = None


@dataclass
class Rounds:
    """Parts of a program that are run again and again."""

    loop: int
    body: list[Part | Rounds]


@dataclass
class Layout:
    """Where expressions live: the part each is computed in, and slots for those that other parts read.

    places: Of each loop which scalars of its state count.
    """

    places: dict[int, list[int]]
    program: list[Part | Rounds] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    ends: dict[int, int] = field(default_factory=dict)
    part_of: dict[int, Part] = field(default_factory=dict)
    last_use: dict[int, int] = field(default_factory=dict)
    slots: dict[int, int] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=lambda: {FLOAT: 1, INT: 1, BOOL: 1})

    def operations(self, scalars: Scalars) -> int:
        """How many a row takes at most."""
        total = 0
        for part in self.parts:
            rounds = 1
            for loop in part.path:
                rounds *= scalars.loops[loop].times
            total += rounds * len(part.statements)
        return total


def kept_as(scalars: Scalars, index: int) -> int:
    """The expression in whose slot the value of this one is: a loop's outcome is where its variable was."""
    entry = scalars.entry_of.get(index)
    return index if entry is None else scalars.loops[entry.loop].variables[entry.place]


def laid_out(trace: Trace) -> Layout:
    """Only what the results need, in an order that keeps an operand near its use."""
    scalars = trace.scalars
    block, needed = ordered(scalars, [index for row in trace.results for index in row])
    layout = Layout(needed)
    layout.program = _divided(layout, block, ())
    if not isinstance(layout.program[-1], Part):
        layout.program.append(_part(layout, ()))
    _note_uses(layout, trace)
    _allocate(layout, scalars)
    return layout


def _part(layout: Layout, path: tuple[int, ...]) -> Part:
    part = Part(len(layout.parts), path)
    layout.parts.append(part)
    return part


def _divided(layout: Layout, block: Block, path: tuple[int, ...]) -> list[Part | Rounds]:
    """A block in parts that a compiler takes well; a loop's body begins and ends with a part."""
    pieces: list[Part | Rounds] = [part := _part(layout, path)]
    for item in block:
        if isinstance(item, Run):
            part.begins.append(item.loop)
            inner = _divided(layout, item.body, (*path, item.loop))
            last = inner[-1]
            if not isinstance(last, Part):
                inner.append(last := _part(layout, (*path, item.loop)))
            last.carries = item.loop
            layout.ends[item.loop] = last.number
            pieces += [Rounds(item.loop, inner), part := _part(layout, path)]
            continue
        if len(part.statements) == STATEMENTS:
            pieces.append(part := _part(layout, path))
        part.statements.append(item)
        layout.part_of[item] = part
    return pieces


def _note_uses(layout: Layout, trace: Trace) -> None:
    """Of each expression the last part that needs it; what a loop needs from before, it needs to its end."""
    scalars = trace.scalars

    def used(index: int, part: Part) -> None:
        keeper = kept_as(scalars, index)
        home = layout.part_of.get(keeper)
        if home is None:
            return
        deeper = part.path[len(home.path) :]
        until = layout.ends[deeper[0]] if deeper else part.number
        layout.last_use[keeper] = max(until, layout.last_use.get(keeper, 0))

    for part in layout.parts:
        for loop in part.begins:
            for k in layout.places[loop]:
                layout.part_of[scalars.loops[loop].variables[k]] = part
    for part in layout.parts:
        for index in part.statements:
            for operand in scalars[index].operands:
                used(operand, part)
        for loop in part.begins:
            for k in layout.places[loop]:
                used(scalars.loops[loop].initial[k], part)
        if part.carries is not None:
            for k in layout.places[part.carries]:
                used(scalars.loops[part.carries].results[k], part)
                used(scalars.loops[part.carries].variables[k], part)
    for row in trace.results:
        for index in row:
            if index in scalars.entry_of:
                used(index, layout.parts[-1])


def _allocate(layout: Layout, scalars: Scalars) -> None:
    """A slot for each expression that a later part reads; slots are used again when their last reader is done."""
    free: dict[str, list[int]] = {FLOAT: [], INT: [], BOOL: []}
    ending: dict[int, list[int]] = {}

    def place(index: int, part: Part) -> None:
        kind = scalars[index].kind
        if free[kind]:
            layout.slots[index] = free[kind].pop()
        else:
            layout.slots[index] = layout.sizes[kind]
            layout.sizes[kind] += 1
        ending.setdefault(layout.last_use.get(index, part.number), []).append(index)

    for part in layout.parts:
        for done in ending.pop(part.number - 1, []):
            free[scalars[done].kind].append(layout.slots[done])
        for index in part.statements:
            if layout.last_use.get(index, part.number) > part.number:
                place(index, part)
        for loop in part.begins:
            for k in layout.places[loop]:
                place(scalars.loops[loop].variables[k], part)
