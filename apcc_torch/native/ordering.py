"""The order in which a program computes its expressions, and in which of its loops."""

from __future__ import annotations

from typing import NamedTuple

from apcc_torch.native.scalars import Scalars


class Run(NamedTuple):
    """A loop that is run, with its body."""

    loop: int
    body: Block


Block = list["int | Run"]


def ordered(scalars: Scalars, results: list[int]) -> tuple[Block, dict[int, list[int]]]:
    """What the results need, each expression in the innermost loop on whose state it depends.

    Args:
        scalars: The expressions.
        results: Those that are asked for.

    Returns:
        The program, and for each loop which places of its state count.
    """
    order = _Order(scalars, needed(scalars, results)[0])
    block, _ = order.block(results, None)
    return block, {loop: sorted(places) for loop, places in order.needed.items()}


def needed(scalars: Scalars, results: list[int]) -> tuple[dict[int, set[int]], bytearray]:
    """What the results depend on.

    Returns:
        Of each loop the places of its state that count, the one that asks for another round among them; and of each
        expression whether it does.
    """
    places: dict[int, set[int]] = {}
    seen = bytearray(len(scalars.expressions))
    stack = list(results)
    while stack:
        index = stack.pop()
        if seen[index]:
            continue
        seen[index] = 1
        stack.extend(scalars[index].operands)
        entry = scalars.entry_of.get(index)
        if entry is None:
            continue
        loop = scalars.loops[entry.loop]
        if entry.loop not in places:
            assert loop.going is not None
            places[entry.loop] = set()
            stack.append(loop.variables[loop.going])
        if entry.place not in places[entry.loop]:
            places[entry.loop].add(entry.place)
            # Marked by hand, not by its index: variable and outcome are two expressions of one place.
            stack += [loop.initial[entry.place], loop.results[entry.place]]
    return places, seen


class _Order:
    """Depth first from each result: what a result needs is computed just before it."""

    def __init__(self, scalars: Scalars, needed: dict[int, set[int]]) -> None:
        self.scalars = scalars
        self.needed = needed
        self._done = bytearray(len(scalars.expressions))
        self._run: set[int] = set()
        self._home = self._homes()

    def _depth(self, loop: int | None) -> int:
        depth = 0
        while loop is not None:
            loop, depth = self.scalars.loops[loop].parent, depth + 1
        return depth

    def _homes(self) -> list[int | None]:
        """The innermost loop on whose state each expression depends, None outside of loops."""
        depth: dict[int | None, int] = {loop: self._depth(loop) for loop in (None, *range(len(self.scalars.loops)))}
        homes: list[int | None] = []
        for index, expression in enumerate(self.scalars.expressions):
            entry = self.scalars.entry_of.get(index)
            if entry is not None:
                within = expression.op == "variable"
                homes.append(entry.loop if within else self.scalars.loops[entry.loop].parent)
            else:
                homes.append(max((homes[i] for i in expression.operands), key=depth.__getitem__, default=None))
        return homes

    def block(self, results: list[int], loop: int | None) -> tuple[Block, list[int]]:
        """What these expressions need in a loop, in order, and what they need from outside of it."""
        order: Block = []
        outside: dict[int, None] = {}
        stack: list[tuple[int | Run, bool]] = [(index, False) for index in reversed(results)]
        while stack:
            item, ready = stack.pop()
            if ready:
                order.append(item)
            elif not isinstance(item, int) or self.scalars[item].value is not None:
                continue
            elif self._home[item] != loop:
                outside[item] = None
            elif not self._done[item]:
                self._done[item] = 1
                entry = self.scalars.entry_of.get(item)
                if entry is None:
                    stack.append((item, True))
                    stack.extend((i, False) for i in reversed(self.scalars[item].operands))
                elif entry.loop != loop and entry.loop not in self._run:
                    self._run.add(entry.loop)
                    run, before = self._inner(entry.loop)
                    stack.append((run, True))
                    stack.extend((i, False) for i in reversed(before))
        return order, list(outside)

    def _inner(self, number: int) -> tuple[Run, list[int]]:
        """A loop, and what has to be there before it."""
        loop = self.scalars.loops[number]
        places = sorted(self.needed[number])
        body, outside = self.block([loop.results[k] for k in places], number)
        return Run(number, body), [*(loop.initial[k] for k in places), *outside]
