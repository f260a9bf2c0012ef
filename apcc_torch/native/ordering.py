"""The order in which a program computes its expressions, and in which of its loops."""

from __future__ import annotations

from typing import NamedTuple

from apcc_torch.native.scalars import Returned, Scalars


class Run(NamedTuple):
    """A loop that is run, with its body; or a call of a routine, with its number, and the body at the first."""

    loop: int
    body: Block | None
    call: int | None = None


Block = list["int | Run"]


def ordered(scalars: Scalars, results: list[int]) -> tuple[Block, dict[int, list[int]]]:
    """What the results need, each expression in the innermost loop on whose state it depends.

    Args:
        scalars: The expressions.
        results: Those that are asked for.

    Returns:
        The program, and for each loop which places of its state count.
    """
    order = _Order(scalars, *needed(scalars, results))
    block, _ = order.block(results, None)
    return block, {loop: sorted(places) for loop, places in order.needed.items()}


def needed(scalars: Scalars, results: list[int]) -> tuple[dict[int, set[int]], bytearray]:
    """What the results depend on.

    Returns:
        Of each loop the places of its state that count, the one that asks for another round among them; and of each
        expression whether it does.
    """
    places: dict[int, set[int]] = {}
    calls: dict[int, set[int]] = {}
    seen = bytearray(len(scalars.expressions))
    stack = list(results)
    while stack:
        index = stack.pop()
        if seen[index]:
            continue
        seen[index] = 1
        operands = scalars.expressions[index].operands
        if operands:
            stack.extend(operands)
            continue
        back, entry = scalars.returned_of.get(index), scalars.entry_of.get(index)
        if back is not None:
            stack += _handed_in(scalars, back, places, calls)
        if entry is None:
            continue
        loop = scalars.loops[entry.loop]
        if loop.calls:
            if entry.place not in places[entry.loop]:
                places[entry.loop].add(entry.place)
                stack += [loop.calls[call][entry.place] for call in calls[entry.loop]]
            continue
        if entry.loop not in places:
            assert loop.going is not None
            places[entry.loop] = set()
            stack.append(loop.variables[loop.going])
        if entry.place not in places[entry.loop]:
            places[entry.loop].add(entry.place)
            # Marked by hand, not by its index: variable and outcome are two expressions of one place.
            stack += [loop.initial[entry.place], loop.results[entry.place]]
    return places, seen


def _handed_in(scalars: Scalars, back: Returned, places: dict[int, set[int]], calls: dict[int, set[int]]) -> list[int]:
    """Notes that what a call came to is needed, and returns what it needs for that beyond what was known before."""
    routine, further = scalars.loops[back.routine], list[int]()
    counted, made = places.setdefault(back.routine, set()), calls.setdefault(back.routine, set())
    if back.call not in made:
        made.add(back.call)
        given = routine.calls[back.call]
        further += [given[k] for k in counted if k < len(given)]
    if back.place not in counted:
        counted.add(back.place)
        further.append(routine.results[back.place])
    return further


class _Order:
    """Depth first from each result: what a result needs is computed just before it."""

    def __init__(self, scalars: Scalars, needed: dict[int, set[int]], seen: bytearray) -> None:
        self.scalars = scalars
        self.needed = needed
        self._back: dict[tuple[int, int], list[int]] = {}  # what counts of what each call comes to
        for index, at in scalars.returned_of.items():
            if seen[index]:
                self._back.setdefault((at.routine, at.call), []).append(index)
        self._bodies: dict[int, tuple[Block, list[int]]] = {}
        self._written: set[int] = set()
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
            if expression.operands:
                home = None
                for operand in expression.operands:
                    other = homes[operand]
                    if other is not None and depth[other] > depth[home]:
                        home = other
                homes.append(home)
                continue
            entry, back = self.scalars.entry_of.get(index), self.scalars.returned_of.get(index)
            if back is not None:
                homes.append(self.scalars.loops[back.routine].parent)
            elif entry is not None:
                within = expression.op == "variable"
                homes.append(entry.loop if within else self.scalars.loops[entry.loop].parent)
            else:
                homes.append(None)
        return homes

    def block(self, results: list[int], loop: int | None) -> tuple[Block, list[int]]:
        """What these expressions need in a loop, in order, and what they need from outside of it."""
        order: Block = []
        outside: dict[int, None] = {}
        expressions = self.scalars.expressions
        stack: list[tuple[int | Run, bool]] = [(index, False) for index in reversed(results)]
        while stack:
            item, ready = stack.pop()
            if ready:
                order.append(self._once(item))
            elif not isinstance(item, int) or (expression := expressions[item]).value is not None:
                continue
            elif self._home[item] != loop:
                outside[item] = None
            elif not self._done[item]:
                self._done[item] = 1
                if expression.operands:
                    stack.append((item, True))
                    stack.extend([(i, False) for i in reversed(expression.operands)])
                    continue
                entry, back = self.scalars.entry_of.get(item), self.scalars.returned_of.get(item)
                if back is not None:
                    # All of it at once: the next call overwrites it.
                    together = self._back[back.routine, back.call]
                    for index in together:
                        self._done[index] = 1
                    stack.extend((index, True) for index in reversed(together))
                    stack.append((Run(back.routine, None, back.call), True))
                    stack.extend((i, False) for i in reversed(self._before(back)))
                elif entry is None:
                    order.append(item)
                elif entry.loop != loop and entry.loop not in self._run:
                    self._run.add(entry.loop)
                    run, before = self._inner(entry.loop)
                    stack.append((run, True))
                    stack.extend((i, False) for i in reversed(before))
        return order, list(outside)

    def _before(self, back: Returned) -> list[int]:
        """What has to be there before a call."""
        routine, places = self.scalars.loops[back.routine], sorted(self.needed[back.routine])
        if back.routine not in self._bodies:
            self._bodies[back.routine] = self.block([routine.results[k] for k in places], back.routine)
        given = routine.calls[back.call]
        return [*(given[k] for k in places if k < len(given)), *self._bodies[back.routine][1]]

    def _once(self, item: int | Run) -> int | Run:
        """A call with the body of its routine where it is the first."""
        if isinstance(item, int) or item.call is None or item.loop in self._written:
            return item
        self._written.add(item.loop)
        return item._replace(body=self._bodies[item.loop][0])

    def _inner(self, number: int) -> tuple[Run, list[int]]:
        """A loop, and what has to be there before it."""
        loop = self.scalars.loops[number]
        places = sorted(self.needed[number])
        body, outside = self.block([loop.results[k] for k in places], number)
        return Run(number, body), [*(loop.initial[k] for k in places), *outside]
