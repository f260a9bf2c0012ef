"""Finds the rounds of a loop in the straight line that tracing makes of it, and writes them once.

A loop of Python is traced round after round. Two rounds look alike: the same operations in the same order, each of
whose operands is what it was a round ago (what comes from outside), or lies one round's length further on (what the
round itself or the one before it has computed). So a loop is a stretch of expressions that equals itself shifted by one
round. Whatever was computed in it before is computed in it after, operation by operation: the results have the same
bits.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apcc_torch.native.scalars import Expression

WINDOW = 64
"""Operations in a row that hint at a loop where they come again."""
LEAST = 300
"""Statements that a loop must save."""
CANDIDATES = 6
"""Lengths of a round that are tried."""
CARRIED = "carried"
"""The operation of what a round takes from the one before it, or the first from outside."""

Ints = NDArray[np.int64]


class Handed(NamedTuple):
    """What rounds hand on: the carried expression, what it is in the first round, what it is from then on."""

    carried: int
    first: int
    next: int


class Loop(NamedTuple):
    """Statements of one round, by index; how many rounds; and what they hand on."""

    statements: list[int]
    rounds: int
    handed: list[Handed]


class Rolled(NamedTuple):
    """Expressions with loops.

    expressions: As they were, operands of what is left pointing to what is left; carried ones behind them.
    results: As they were, likewise.
    segments: Statements in the order in which they are run, by index: a list, or a loop of such.
    """

    expressions: list[Expression]
    results: list[list[int]]
    segments: list[list[int] | Loop]


class _Stretch(NamedTuple):
    """Rounds among the statements: where the first begins, a round's length, and how many."""

    begin: int
    period: int
    rounds: int

    @property
    def end(self) -> int:
        """Behind the last round."""
        return self.begin + self.period * self.rounds


def statements(expressions: list[Expression]) -> list[int]:
    """The expressions that are computed, by index: neither inputs nor what is known."""
    return [index for index, expression in enumerate(expressions) if expression.value is None]


def unrolled(expressions: list[Expression], results: list[list[int]]) -> Rolled:
    """Expressions as they are, without a loop."""
    return Rolled(expressions, results, [statements(expressions)])


def rolled(expressions: list[Expression], results: list[list[int]]) -> Rolled:
    """Expressions with the loops that are found in them."""
    table = _Table(expressions)
    found = sorted(_stretches(table, 0, len(table.order), results))
    return _rewritten(expressions, results, table, found) if found else unrolled(expressions, results)


class _Table:
    """Statements as arrays: what each computes, and the place of each operand among them.

    order: Their indices. kind: (N,) a number for each operation. operands: (N, most) places; what is no statement is
    less than -1, and what is not there -1. last_use: (N,) the last place that reads each, N of a result.
    """

    def __init__(self, expressions: list[Expression]) -> None:
        self.order = statements(expressions)
        self.place = {index: k for k, index in enumerate(self.order)}
        kinds: dict[tuple[str, str, int], int] = {}
        most = max((len(expressions[index].operands) for index in self.order), default=1)
        self.kind = np.zeros(len(self.order), dtype=np.int64)
        self.operands = np.full((len(self.order), most), -1, dtype=np.int64)
        for k, index in enumerate(self.order):
            expression = expressions[index]
            form = expression.op, expression.kind, len(expression.operands)
            self.kind[k] = kinds.setdefault(form, len(kinds))
            for slot, operand in enumerate(expression.operands):
                self.operands[k, slot] = self.place.get(operand, -2 - operand)


def _stretches(table: _Table, low: int, high: int, results: list[list[int]]) -> list[_Stretch]:
    """The loops between two places, the one that saves most and what lies before and after it."""
    best = max(
        (each for period in _periods(table.kind[low:high]) for each in _repeats(table, low, high, period)),
        key=lambda each: each.period * (each.rounds - 1),
        default=None,
    )
    if best is None or best.period * (best.rounds - 1) < LEAST or not _closed(table, best, results):
        return []
    return [*_stretches(table, low, best.begin, results), best, *_stretches(table, best.end, high, results)]


def _periods(kind: Ints) -> list[int]:
    """Distances at which operations come again, the most frequent first."""
    text, votes = kind.astype(np.uint8).tobytes(), Counter[int]()
    last: dict[bytes, int] = {}
    for k in range(len(text) - WINDOW):
        window = text[k : k + WINDOW]
        if window in last:
            votes[k - last[window]] += 1
        last[window] = k
    return [period for period, count in votes.most_common() if period >= WINDOW and count >= LEAST][:CANDIDATES]


def _repeats(table: _Table, low: int, high: int, period: int) -> list[_Stretch]:
    """The longest stretch between two places that equals itself one period on, as rounds."""
    kind, operands = table.kind[low:high], table.operands[low:high]
    if 2 * period > len(kind):
        return []
    now, later = operands[:-period], operands[period:]
    moved = (later == now + period) & (now >= 0)
    alike = kind[:-period] == kind[period:]
    same = alike & ((later == now) | moved).all(1)
    begin, length = _longest(same)
    if length < period:
        return []
    plain = _Stretch(low + begin, period, length // period + 1)
    # The round before these, whose operations are theirs too: only what is handed to it may come from anywhere. Where
    # its first statements are none of that kind, rounds begin behind them.
    skipped = 0
    while (more := _misfits(table, low, plain.begin + skipped, period)) and skipped + more <= length:
        skipped += more
    rounds = (length - skipped) // period + 2
    if more or skipped + period > length or rounds <= plain.rounds:
        return [plain]
    return [_Stretch(plain.begin + skipped - period, period, rounds)]


def _longest(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """Where the longest run of true begins, and its length."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 0
    k = int(np.argmax(ends - begins))
    return int(begins[k]), int(ends[k] - begins[k])


def _misfits(table: _Table, low: int, first: int, period: int) -> int:
    """How many statements of the round before `first` go by before it is one, as far as it is not handed anything."""
    if first - period < low:
        return period
    before, now, later = (table.operands[first + k * period : first + (k + 1) * period] for k in (-1, 0, 1))
    if len(later) < period:
        return period
    alike = table.kind[first - period : first] == table.kind[first : first + period]
    handed = (later == now + period) & (now >= 0) & (now < first)
    within = (later == now + period) & (now >= first) & (now == before + period)
    outside = (later == now) & (now == before)
    wrong = np.flatnonzero(~(alike & (handed | within | outside).all(1)))
    return int(wrong[-1]) + 1 if len(wrong) else 0


def _closed(table: _Table, each: _Stretch, results: list[list[int]]) -> bool:
    """Whether rounds use of each other only what the one before has computed, and what follows only the last's."""
    begin, period = each.begin, each.period
    operands = table.operands[begin : each.end]
    place = np.arange(begin, each.end)[:, None]
    start = begin + (place - begin) // period * period  # of the round that a statement is in
    near = (operands < begin) | (operands >= start - period)
    now, later = operands[:period], operands[period : 2 * period]
    fixed = (now == later) & (now < begin)
    moved = (now != later) & (later >= begin)
    first = bool((fixed | moved).all())
    behind = table.operands[each.end :]
    last = (behind < begin) | (behind >= each.end - period)
    told = [table.place[index] for row in results for index in row if index in table.place]
    return first and bool(near.all() and last.all()) and all(k < begin or k >= each.end - period for k in told)


def _rewritten(expressions: list[Expression], results: list[list[int]], table: _Table, found: list[_Stretch]) -> Rolled:
    """The expressions with each loop's first round for all of them."""
    made = list(expressions)
    alias: dict[int, int] = {}  # of a later round: the same in the first
    for each in found:
        for k in range(each.begin + each.period, each.end):
            alias[table.order[k]] = table.order[each.begin + (k - each.begin) % each.period]
    segments: list[list[int] | Loop] = []
    at = 0
    for each in found:
        segments.append(table.order[at : each.begin])
        segments.append(_loop(made, table, each, alias))
        at = each.end
    segments.append(table.order[at:])
    for segment in segments:
        if isinstance(segment, list):
            for index in segment:
                operands = tuple(alias.get(i, i) for i in made[index].operands)
                made[index] = made[index]._replace(operands=operands)
    return Rolled(made, [[alias.get(i, i) for i in row] for row in results], segments)


def _loop(made: list[Expression], table: _Table, each: _Stretch, alias: dict[int, int]) -> Loop:
    """One loop; its statements get their operands, and what is handed on an expression of its own."""
    handed: dict[tuple[int, int], Handed] = {}
    body = table.order[each.begin : each.begin + each.period]
    for k, index in enumerate(body, each.begin):
        operands = list(made[index].operands)
        following = made[table.order[k + each.period]].operands
        for slot, (now, later) in enumerate(zip(operands, following, strict=True)):
            if now == later:
                operands[slot] = alias.get(now, now)  # from outside
            elif table.place.get(now, -1) < each.begin:
                pair = now, later
                if pair not in handed:
                    made.append(Expression(CARRIED, (), made[now].kind))
                    handed[pair] = Handed(len(made) - 1, alias.get(now, now), alias.get(later, later))
                operands[slot] = handed[pair].carried
        made[index] = made[index]._replace(operands=tuple(operands))
    return Loop(body, each.rounds, list(handed.values()))
