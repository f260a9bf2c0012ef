"""The order of a program whose formulas are written once for several slices: what runs together in one small loop."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush

from apcc_torch.native.alike import Formula, Places, formulas, shared
from apcc_torch.native.ordering import Block, Run
from apcc_torch.native.scalars import Scalars
from apcc_torch.native.trace import Trace


@dataclass(frozen=True)
class Series:
    """Formulas that a loop over their slices computes.

    Within a slice each may need those before it; what it needs of another slice, was there before the loop.
    """

    length: int
    formulas: tuple[Formula, ...]


Items = list["int | Series | Rounds"]


@dataclass(frozen=True)
class Rounds:
    """A loop of the program that is run, or a routine that is called: as `ordering.Run`."""

    loop: int
    body: Items | None
    call: int | None


def in_series(trace: Trace, block: Block, most: int) -> Items:
    """A program's block with its formulas in series of at most so many."""
    blocks = [-1] * len(trace.scalars.expressions)
    _number(block, blocks, 0)
    by_block: dict[int, list[Formula]] = {}
    for formula in formulas(trace.scalars, trace.calls, blocks):
        by_block.setdefault(blocks[formula.results[0]], []).append(formula)
    return _rewritten(trace.scalars, block, blocks, by_block, most)


def one_by_one(block: Block) -> Items:
    """A program's block as it is."""
    return [
        Rounds(item.loop, None if item.body is None else one_by_one(item.body), item.call)
        if isinstance(item, Run)
        else item
        for item in block
    ]


def _number(block: Block, blocks: list[int], number: int) -> int:
    """Numbers the stretches of a program that no loop interrupts, and returns the next number."""
    for item in block:
        if isinstance(item, Run):
            number = _number(item.body or [], blocks, number + 1) + 1
        else:
            blocks[item] = number
    return number


def _rewritten(
    scalars: Scalars, block: Block, blocks: list[int], by_block: dict[int, list[Formula]], most: int
) -> Items:
    items: Items = []
    stretch: list[int] = []

    def end() -> None:
        if stretch:
            items.extend(_Stretch(scalars, stretch, by_block.get(blocks[stretch[0]], []), most).ordered())
            stretch.clear()

    for item in block:
        if isinstance(item, Run):
            end()
            body = None if item.body is None else _rewritten(scalars, item.body, blocks, by_block, most)
            items.append(Rounds(item.loop, body, item.call))
        else:
            stretch.append(item)
    end()
    return items


class _Stretch:
    """Orders expressions, and formulas of them: greedily, what came first first, and with each formula its like."""

    def __init__(self, scalars: Scalars, stretch: list[int], found: list[Formula], most: int) -> None:
        self.scalars = scalars
        self.most = most
        # A node is a formula with all its results, or an expression alone.
        self.nodes: list[Formula | int] = list(found)
        self.node_of = {index: node for node, formula in enumerate(found) for index in formula.results}
        for index in stretch:
            if index not in self.node_of:
                self.node_of[index] = len(self.nodes)
                self.nodes.append(index)
        rank = {index: k for k, index in enumerate(stretch)}
        self.first = [min(rank[i] for i in _results(node)) for node in self.nodes]
        self._link()

    def _link(self) -> None:
        """Counts for each node what has to be there before it."""
        self.waiting = [0] * len(self.nodes)
        self.after: list[list[int]] = [[] for _ in self.nodes]
        for node, what in enumerate(self.nodes):
            needed = {
                self.node_of[operand]
                for index in _results(what)
                for operand in self.scalars[index].operands
                if operand in self.node_of
            }
            self.waiting[node] = len(needed)
            for other in needed:
                self.after[other].append(node)

    def ordered(self) -> list[int | Series]:
        """The expressions and series, operands first."""
        self.alone: list[tuple[int, int]] = []
        self.alike: dict[int, list[tuple[int, int]]] = {}
        for node, count in enumerate(self.waiting):
            if count == 0:
                self._ready(node)
        items: list[int | Series] = []
        while True:
            lengths = [length for length, heap in self.alike.items() if heap]
            length = min(lengths, key=lambda n: self.alike[n][0], default=None)
            if self.alone and (length is None or self.alone[0] < self.alike[length][0]):
                node = heappop(self.alone)[1]
                index = self.nodes[node]
                assert isinstance(index, int)
                items.append(index)
                self._done(node)
            elif length is not None:
                items.append(self._together(length))
            else:
                break
        assert not any(self.waiting), "each call's formulas have an order, and so have the calls"
        return items

    def _ready(self, node: int) -> None:
        what = self.nodes[node]
        heap = self.alone if isinstance(what, int) else self.alike.setdefault(len(what.results), [])
        heappush(heap, (self.first[node], node))

    def _done(self, node: int) -> None:
        for other in self.after[node]:
            self.waiting[other] -= 1
            if self.waiting[other] == 0:
                self._ready(other)

    def _together(self, length: int) -> Series:
        """A series of what is ready and what becomes so, of one number of slices."""
        heap = self.alike[length]
        body: list[Formula] = []
        made: dict[int, Places] = {}
        later = []
        while heap and len(body) < self.most:
            rank, node = heappop(heap)
            formula = self.nodes[node]
            assert isinstance(formula, Formula)
            if not all(_within(operand, made) for operand in formula.operands):
                later.append((rank, node))
                continue
            body.append(formula)
            made.update(dict.fromkeys(formula.results, formula.results))
            self._done(node)
        for entry in later:
            heappush(heap, entry)
        return Series(length, tuple(body))


def _results(what: Formula | int) -> Places:
    return (what,) if isinstance(what, int) else what.results


def _within(operand: Places, made: dict[int, Places]) -> bool:
    """Whether an operand is there in its slice; what a series has made so far, is there in its own slice alone."""
    if shared(operand):
        return operand[0] not in made
    return made.get(operand[0]) == operand or not any(index in made for index in operand)
