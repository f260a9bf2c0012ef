"""Repetitions in machine code: written once, run as often as a row needs, and equal to what Python does."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.layout import laid_out
from apcc_torch.native.source import Plan
from apcc_torch.native.trace import Trace, traced
from apcc_torch.repetition import repeated
from laws import generator, normal

D = torch.float64


class Root(NamedTuple):
    """A square root on its way: a guess, what it is of, whether it goes on, its steps, and a part that stays."""

    guess: Tensor
    square: Tensor
    going: Tensor
    steps: Tensor
    still: Tensor


class Newton(nn.Module):
    """Square roots, entry by entry, by Newton's method; entries end on their own."""

    def __init__(self, times: int = 30, factor: float = 0.5) -> None:
        super().__init__()
        self.times, self.factor = times, factor

    def forward(self, square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shared = square.sum(-1, keepdim=True)  # does not change: it has no place in the loop

        def once(now: Root) -> Root:
            guess = self.factor * (now.guess + now.square / now.guess) + 0.0 * shared
            guess = torch.where(now.going, guess, now.guess)
            going = now.going & ((guess * guess - now.square).abs() > 1e-12 * now.square)
            return Root(guess, now.square, going, now.steps + now.going, now.still * 1.0)

        going = torch.ones_like(square, dtype=torch.bool)
        start = Root(torch.ones_like(square), square, going, torch.zeros_like(square), torch.zeros_like(square))
        end = repeated(once, start, self.times, lambda now: now.going)
        return end.guess, end.steps, end.still + shared


class Nested(nn.Module):
    """Loops in a loop, one after the other, the second on what the first came to, and swapped scalars."""

    def forward(self, x: Tensor) -> Tensor:
        def inner(pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            a, b = pair
            return b, torch.sin(a) + 0.5 * x

        def outer(pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            a, b = repeated(inner, pair, 3, lambda pair: pair[0] < 1e9)
            b, a = repeated(inner, (b, a * x.cos()), 2, lambda pair: pair[0] < 1e9)
            return a, b

        a, b = repeated(outer, (x, 2.0 * x), 4, lambda pair: pair[1] > -1e9)
        return torch.cat(repeated(inner, (a, b), 2, lambda pair: pair[0] < 1e9), dim=-1)


def squares(batch: tuple[int, ...]) -> Tensor:
    return normal((*batch, 3), D, generator(5)).square() + 0.1


@pytest.mark.parametrize("batch", [(), (5,), (33,)])
def test_each_row_goes_its_own_number_of_rounds(batch: tuple[int, ...]) -> None:
    square = squares(batch)
    roots, steps, rest = NativeFunction(Newton(), (squares(()),))(square)
    torch.testing.assert_close(roots, square.sqrt(), rtol=1e-12, atol=0.0)
    want = Newton()(square)
    assert torch.equal(steps, want[1]) and (not batch or steps.min() != steps.max())
    torch.testing.assert_close(rest, want[2], rtol=1e-15, atol=0.0)


@pytest.mark.parametrize("times", [0, 1, 2, 3])
def test_no_more_rounds_than_asked_for(times: int) -> None:
    square = squares((7,))
    have, want = NativeFunction(Newton(times), (square[0],))(square), Newton(times)(square)
    for a, b in zip(have, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-15, atol=0.0)


@pytest.mark.parametrize("batch", [(), (9,)])
def test_loops_in_loops(batch: tuple[int, ...]) -> None:
    x = normal((*batch, 3), D, generator(6))
    have = NativeFunction(Nested(), (normal((3,), D, generator(7)),))(x)
    torch.testing.assert_close(have, Nested()(x), rtol=1e-14, atol=1e-15)


def written(module: nn.Module, *example: Tensor) -> tuple[Trace, int]:
    trace = traced(module, example)
    return trace, sum(len(part.statements) for part in laid_out(trace).parts)


def test_a_loop_is_written_once() -> None:
    _, few = written(Newton(3), squares(()))
    trace, many = written(Newton(300), squares(()))
    assert few == many
    assert laid_out(trace).operations(trace.scalars) > 100 * few


def test_what_does_not_change_is_no_variable() -> None:
    trace, _ = written(Newton(), squares(()))
    (places,) = laid_out(trace).places.values()
    # Of each entry the guess, the square, whether it goes on and its steps, and whether any goes on; what is zero stays
    # a constant.
    assert len(places) == 4 * 3 + 1


def test_bad_rows_stay_alone() -> None:
    square = squares((11,))
    step = NativeFunction(Newton(), (square[0],))
    clean = step(square)[0]
    square[4] = torch.nan
    others = torch.arange(11) != 4
    assert torch.equal(step(square)[0][others], clean[others])


def test_settings_share_a_library() -> None:
    def name(factor: float) -> str:
        step = NativeFunction(Newton(factor=factor), (squares(()),))
        return Plan(traced(step.traced, step.example), 1, D, []).name()

    assert name(0.51) == name(0.63)


def test_a_state_that_changes_its_form_is_refused() -> None:
    class Grows(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return repeated(lambda x: torch.cat((x, x)), x, 3, lambda x: x > 0.0)

    with pytest.raises(CompileError, match="must hand on what it was given"):
        NativeFunction(Grows(), (torch.ones(2, dtype=D),)).program(1)
