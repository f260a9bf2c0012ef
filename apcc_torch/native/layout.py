"""Where the expressions of a program are computed and kept: in which part, and in which slot between parts."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from apcc_torch.native.loops import Handed, Loop, Rolled, rolled, unrolled
from apcc_torch.native.scalars import BOOL, FLOAT, INT, Expression
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
class PlacedLoop:
    """A loop's parts, from the first to the last; how many rounds; and what they hand on."""

    first: int
    last: int
    rounds: int
    handed: list[Handed]


@dataclass
class Layout:
    """Where expressions live: the part each is computed in, and slots for those that other parts read.

    expressions: With loops. results: Likewise. parts: Their statements, in order.
    """

    expressions: list[Expression]
    results: list[list[int]]
    parts: list[list[int]] = field(default_factory=list)
    loops: list[PlacedLoop] = field(default_factory=list)
    part_of: dict[int, int] = field(default_factory=dict)
    last_use: dict[int, int] = field(default_factory=dict)
    slots: dict[int, int] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=lambda: {FLOAT: 1, INT: 1, BOOL: 1})


def laid_out(trace: Trace, loops: bool) -> Layout:
    """Only what the results need, in an order that keeps an operand near its use.

    Args:
        trace: From `traced`.
        loops: Whether loops are looked for.
    """
    made = (rolled if loops else unrolled)(trace.scalars.expressions, trace.results)
    layout = Layout(made.expressions, made.results)
    needed, wanted = _needed(made)
    for segment in made.segments:
        inside = segment.statements if isinstance(segment, Loop) else segment
        order = _ordered(made, [index for index in inside if index in needed], wanted)
        first = len(layout.parts)
        layout.parts += [order[k : k + STATEMENTS] for k in range(0, len(order), STATEMENTS)]
        if isinstance(segment, Loop) and order:
            handed = [each for each in segment.handed if each.carried in needed]
            layout.loops.append(PlacedLoop(first, len(layout.parts) - 1, segment.rounds, handed))
    layout.parts = layout.parts or [[]]
    layout.part_of = {index: k for k, part in enumerate(layout.parts) for index in part}
    _last_uses(layout)
    _allocate(layout)
    return layout


def _needed(made: Rolled) -> tuple[set[int], set[int]]:
    """What the results need, and what of it is read from outside of its segment."""
    handed = {each.carried: each for segment in made.segments if isinstance(segment, Loop) for each in segment.handed}
    home = {}
    for k, segment in enumerate(made.segments):
        home.update(dict.fromkeys(segment.statements if isinstance(segment, Loop) else segment, k))
    waiting = [index for row in made.results for index in row]
    needed, wanted = set(waiting), set(waiting)
    while waiting:
        index = waiting.pop()
        below: tuple[int, ...] = made.expressions[index].operands
        if index in handed:
            below = handed[index].first, handed[index].next
            wanted.update(below)
        wanted.update(operand for operand in below if home.get(operand) != home.get(index))
        waiting += [operand for operand in dict.fromkeys(below) if operand not in needed]
        needed.update(below)
    return needed, wanted


def _ordered(made: Rolled, inside: list[int], wanted: set[int]) -> list[int]:
    """Statements of a segment, depth first from each that is wanted: what one needs is computed just before it."""
    members = set(inside)
    roots = [index for row in made.results for index in row if index in members]
    roots = [*(index for index in inside if index in wanted and index not in set(roots)), *roots]
    order: list[int] = []
    seen: set[int] = set()
    stack = [(index, False) for index in reversed(roots)]
    while stack:
        index, ready = stack.pop()
        if ready:
            order.append(index)
        elif index in members and index not in seen:
            seen.add(index)
            stack.append((index, True))
            stack.extend((i, False) for i in reversed(made.expressions[index].operands))
    return order


def _last_uses(layout: Layout) -> None:
    """The last part that reads each expression; in a loop whatever comes from outside is read until its end."""
    ends = {part: loop for loop in layout.loops for part in range(loop.first, loop.last + 1)}

    def read(index: int, part: int) -> None:
        if index in layout.part_of:
            loop = ends.get(part)
            outside = loop is not None and not loop.first <= layout.part_of[index] <= loop.last
            until = loop.last if loop is not None and outside else part
            layout.last_use[index] = max(until, layout.last_use.get(index, until))

    for k, part in enumerate(layout.parts):
        for index in part:
            for operand in layout.expressions[index].operands:
                read(operand, k)
    for loop in layout.loops:
        for each in loop.handed:
            read(each.first, loop.first)
            if each.next in layout.part_of:
                layout.last_use[each.next] = max(loop.last + 1, layout.last_use.get(each.next, 0))


def _allocate(layout: Layout) -> None:
    """A slot for each expression that a later part reads; slots are used again when their last reader is done.

    What rounds hand on has a slot of its own.
    """
    free: dict[str, list[int]] = {FLOAT: [], INT: [], BOOL: []}
    ending: dict[int, list[int]] = {}

    def placed(index: int) -> None:
        kind = layout.expressions[index].kind
        if free[kind]:
            layout.slots[index] = free[kind].pop()
        else:
            layout.slots[index] = layout.sizes[kind]
            layout.sizes[kind] += 1

    carried = {loop.first: [each.carried for each in loop.handed] for loop in layout.loops}
    for k, part in enumerate(layout.parts):
        for done in ending.pop(k - 1, []):
            free[layout.expressions[done].kind].append(layout.slots[done])
        for index in carried.get(k, ()):
            placed(index)
        for index in part:
            if layout.last_use.get(index, k) > k:
                placed(index)
                ending.setdefault(layout.last_use[index], []).append(index)
