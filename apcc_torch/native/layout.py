"""Where the expressions of a program are computed and kept: in which part, and in which slot between parts."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

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
class Layout:
    """Where expressions live: the part each is computed in, and slots for those that other parts read."""

    order: list[int]
    part_of: dict[int, int]
    last_use: dict[int, int]
    slots: dict[int, int] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=lambda: {FLOAT: 1, INT: 1, BOOL: 1})


def laid_out(trace: Trace) -> Layout:
    """Only what the results need, in an order that keeps an operand near its use."""
    expressions = trace.scalars.expressions
    order: list[int] = []
    seen = bytearray(len(expressions))
    # Depth first from each result: what a result needs is computed just before it.
    stack = [(index, False) for row in reversed(trace.results) for index in reversed(row)]
    while stack:
        index, ready = stack.pop()
        if ready:
            order.append(index)
        elif not seen[index]:
            seen[index] = 1
            if expressions[index].value is not None:
                continue
            stack.append((index, True))
            stack.extend((i, False) for i in reversed(expressions[index].operands))
    part_of = {index: k // STATEMENTS for k, index in enumerate(order)}
    last_use: dict[int, int] = {}
    for index in order:
        for operand in expressions[index].operands:
            if operand in part_of:
                last_use[operand] = part_of[index]
    layout = Layout(order, part_of, last_use)
    _allocate(layout, expressions)
    return layout


def _allocate(layout: Layout, expressions: list[Expression]) -> None:
    """A slot for each expression that a later part reads; slots are used again when their last reader is done."""
    free: dict[str, list[int]] = {FLOAT: [], INT: [], BOOL: []}
    ending: dict[int, list[int]] = {}
    current = 0
    for index in layout.order:
        part = layout.part_of[index]
        while current < part:
            for done in ending.pop(current, []):
                free[expressions[done].kind].append(layout.slots[done])
            current += 1
        if layout.last_use.get(index, part) > part:
            kind = expressions[index].kind
            if free[kind]:
                layout.slots[index] = free[kind].pop()
            else:
                layout.slots[index] = layout.sizes[kind]
                layout.sizes[kind] += 1
            ending.setdefault(layout.last_use[index], []).append(index)
