"""Functions that machine code writes once and calls at several places: equal to what Python does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.native.function import NativeFunction
from apcc_torch.native.gradient import DifferentiableFunction
from apcc_torch.native.layout import Layout, laid_out
from apcc_torch.native.structure import flattened
from apcc_torch.native.trace import traced
from apcc_torch.repetition import repeated, shared
from laws import generator, normal

D = torch.float64


def work(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Something that takes many operations and is linear in nothing."""
    for _ in range(12):
        a = torch.sin(a + 0.3 * b) + 0.1 * a * b.flip(-1)
    return a, (a - b).sum(-1)


class Twice(nn.Module):
    """What a call came to is handed to the next and read after it."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, first = shared(work, x, x + 1.0)
        b, second = shared(work, a, x)
        c, third = shared(work, torch.cos(b), a)
        return a + c, first * second + third, x + b


class Within(nn.Module):
    """In a loop, with a loop and a routine inside, and with what stands outside of both."""

    def forward(self, x: Tensor) -> Tensor:
        outer = torch.exp(0.1 * x)

        def halved(a: Tensor) -> Tensor:
            return repeated(
                lambda s: torch.where(s.abs() > 1.0, 0.5 * s, s) + 0.0 * outer, a, 20, lambda s: s.abs() > 1.0
            )

        def inner(a: Tensor) -> Tensor:
            return shared(work, halved(a), outer)[0] + shared(work, outer, a)[0]

        def once(a: Tensor) -> Tensor:
            return 0.5 * (shared(inner, a) + shared(inner, 3.0 * a) - outer)

        after = repeated(once, x, 4, lambda a: torch.ones_like(a, dtype=torch.bool))
        return after + shared(work, after, x)[1].unsqueeze(-1)


class Kinds(nn.Module):
    """Integers, truth values, numbers, None and nested tuples go in and out; an argument comes out as it is."""

    def forward(self, x: Tensor, n: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        def both(given: tuple[Tensor, Tensor], up: Tensor, none: None, factor: float) -> tuple[Any, Tensor, Tensor]:
            value, count = given
            moved = torch.where(up.unsqueeze(-1), value + factor, value - factor) * count.unsqueeze(-1)
            return (moved, None), count + up, value

        (a, _), m, kept = shared(both, (x, n), x.sum(-1) > 0, None, 0.5)
        (b, _), k, again = shared(both, (a, m), a.sum(-1) > 1, None, 0.5)
        (c, _), j, _ = shared(both, (b, k), b.sum(-1) > 1, None, 0.25)
        return a + b + c, m + k + j, kept - again


class Alike(nn.Module):
    """Calls whose known entries, or whose equal ones, are not the same are not one function to machine code."""

    def forward(self, x: Tensor) -> Tensor:
        y = x.square()
        pairs = [(x, y), (x, x), (torch.zeros_like(x), y), (torch.ones_like(x), y), (y, torch.zeros_like(x)), (y, y)]
        return torch.stack([shared(work, *pair)[0] for pair in pairs])


CASES: list[tuple[Callable[[], nn.Module], tuple[Tensor, ...]]] = [
    (Twice, (torch.zeros(4, dtype=D),)),
    (Within, (torch.zeros(3, dtype=D),)),
    (Kinds, (torch.zeros(3, dtype=D), torch.zeros((), dtype=torch.int64))),
    (Alike, (torch.zeros(4, dtype=D),)),
]


@pytest.mark.parametrize(("made", "example"), CASES, ids=[made.__name__ for made, _ in CASES])
@pytest.mark.parametrize("rows", [1, 13])
def test_what_is_shared_is_as_python_has_it(
    made: Callable[[], nn.Module], example: tuple[Tensor, ...], rows: int
) -> None:
    source = generator(7)
    given = [
        normal((rows, *each.shape), D, source) if each.is_floating_point() else torch.arange(rows) % 3
        for each in example
    ]
    fast, module = NativeFunction(made(), example), made()
    found = flattened(fast(*given))
    expected = zip(*(flattened(module(*row)) for row in zip(*given, strict=True)), strict=True)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, torch.stack(b), rtol=1e-12, atol=1e-12)


def layouts(module: nn.Module, example: Tensor, worth: float) -> tuple[Layout, Layout, int, int]:
    """With what is shared written once, and at every place; and how many operations each takes."""
    one, many = (traced(module, (example,), shares=shares) for shares in (True, False))
    first, second = laid_out(one, worth), laid_out(many, worth)
    return first, second, first.operations(one.scalars), second.operations(many.scalars)


@pytest.mark.parametrize("worth", [0.0, 0.9])
def test_what_is_shared_is_written_once(worth: float) -> None:
    first, second, once, each = layouts(Twice(), torch.ones(4, dtype=D), worth)
    written = [sum(len(part.statements) for part in layout.parts) for layout in (first, second)]
    if not worth:
        assert 2 * written[0] < written[1]
    # No work is saved: reading what a call came to is all that is added.
    assert each <= once <= each + 3 * 5


def test_only_what_is_asked_for_of_a_call_is_computed() -> None:
    class First(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return shared(both, x)[0] + shared(both, 2.0 * x)[0]

    def both(x: Tensor) -> tuple[Tensor, Tensor]:
        return x + 1.0, work(x, x)[0]

    _, _, once, _ = layouts(First(), torch.ones(4, dtype=D), 0.0)
    assert once < 30


def test_what_is_shared_has_a_gradient() -> None:
    class Summed(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return torch.stack([each.sum() for each in Twice()(x)]).sum()

    x = normal((4,), D, generator(3)).requires_grad_()
    (found,) = torch.autograd.grad(DifferentiableFunction(Summed(), (torch.zeros(4, dtype=D),))(x), x)
    (expected,) = torch.autograd.grad(Summed()(x), x)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_eagerly_it_is_the_function_itself() -> None:
    x = torch.ones(3, dtype=D)
    assert all(map(torch.equal, shared(work, x, x), work(x, x)))


def test_a_method_of_another_object_is_another_function() -> None:
    class Scaled(nn.Module):
        def __init__(self, factor: float) -> None:
            super().__init__()
            self.factor = factor

        def scaled(self, x: Tensor) -> Tensor:
            return work(self.factor * x, x)[0]

    class Pair(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.parts = nn.ModuleList([Scaled(2.0), Scaled(3.0)])

        def forward(self, x: Tensor) -> Tensor:
            return torch.stack([shared(part.scaled, x) for part in self.parts for _ in range(2)])

    x = normal((9, 4), D, generator(5))
    found = NativeFunction(Pair(), (torch.zeros(4, dtype=D),))(x)
    torch.testing.assert_close(found, torch.stack([Pair()(row) for row in x]), rtol=1e-12, atol=1e-12)
