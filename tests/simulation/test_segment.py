"""Stretches that keep no record of their operations: the gradients are those of the same stretches in a row."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import GradientError
from apcc_torch.simulation.segment import Forgotten
from laws import generator, normal

D = torch.float64


class Now(NamedTuple):
    x: Tensor
    held: Tensor
    count: Tensor
    nothing: None = None


class Loop:
    """A step that uses tensors in all ways: leaves, what follows from them, one given, one handed out as it is."""

    def __init__(self, given: dict[str, Tensor]) -> None:
        self.leaf, self.shift = given["leaf"], given["shift"]
        self.follows = self.leaf.square() + given["other"]
        self.apart, self.also = given["pair"].unbind()

    def __call__(self, now: Now, given: tuple[Tensor, float]) -> tuple[Now, tuple[Tensor, ...]]:
        push, rate = given
        x = now.x + rate * torch.stack([(self.follows * now.x).sin().sum(), (self.leaf * now.held).sum()])
        x = torch.where(now.count > 1, x * self.apart, x) + torch.cat([push, self.also.reshape(1)])
        return now._replace(x=x, count=now.count + 1), (x.norm(), self.shift, now.held, now.count)


def tensors(dtype: torch.dtype) -> dict[str, Tensor]:
    shapes = {"leaf": (2,), "other": (2,), "pair": (2,), "shift": (3,), "push": (6, 1), "x": (2,), "held": (2,)}
    return {name: normal(shape, dtype, generator(k)).requires_grad_() for k, (name, shape) in enumerate(shapes.items())}


def ran(given: dict[str, Tensor], forgets: bool, loop: Any = Loop, steps: int = 6) -> Tensor:
    """A number that hangs on everything."""
    step = loop(given)
    run = Forgotten(step) if forgets else step
    now, total = Now(given["x"], given["held"], torch.tensor(0)), torch.zeros((), dtype=given["x"].dtype)
    for k in range(steps):
        now, row = run(now, (given["push"][k], 0.1))
        total = total + sum(((k + 1.0) * field.square().sum() for field in row[:3]), start=now.held.sum())
    return total + now.x.prod()


@pytest.mark.parametrize(("dtype", "close"), [(D, 1e-13), (torch.float32, 1e-5)])
def test_gradients_are_those_of_the_stretches_in_a_row(dtype: torch.dtype, close: float) -> None:
    found = {}
    for forgets in (False, True):
        given = tensors(dtype)
        between = {name: 1.5 * value for name, value in given.items()}  # asked for as well: it is no leaf
        total = ran(between, forgets)
        asked = [*given.values(), *between.values()]
        found[forgets] = [total.detach(), *torch.autograd.grad(total, asked)]
    for have, want in zip(found[True], found[False], strict=True):
        assert have.dtype == dtype and float(want.abs().max()) > 0.0
        torch.testing.assert_close(have, want, rtol=close, atol=close)


def test_backward_adds_to_leaves_and_only_those_that_ask() -> None:
    given = tensors(D)
    given["leaf"].requires_grad_(False)
    given["x"].requires_grad_(False)
    ran(given, True).backward()
    want = torch.autograd.grad(ran(given, False), [value for value in given.values() if value.requires_grad])
    have = [value.grad for value in given.values() if value.requires_grad]
    for a, b in zip(have, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    assert given["leaf"].grad is None and given["x"].grad is None


def test_without_a_gradient_nothing_is_kept() -> None:
    given = {name: value.detach() for name, value in tensors(D).items()}
    total = ran(given, True)
    assert total.grad_fn is None and torch.equal(total, ran(given, False))


def nodes(total: Tensor) -> int:
    """How many operations a gradient would go through."""
    stack, met = [total.grad_fn], set()
    while stack:
        node = stack.pop()
        if node is not None and node not in met:
            met.add(node)
            stack += [following for following, _ in node.next_functions]
    return len(met)


class Long(Loop):
    """Many operations a step."""

    def __call__(self, now: Now, given: tuple[Tensor, float]) -> tuple[Now, tuple[Tensor, ...]]:
        for _ in range(200):
            now = now._replace(x=now.x + 1e-3 * now.x.sin())
        return super().__call__(now, given)


def test_operations_are_not_remembered() -> None:
    given = tensors(D)
    assert nodes(ran(given, False, Long)) > 6 * 400 and nodes(ran(given, True, Long)) < 6 * 25


class _Twice(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return 2.0 * x.detach()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return 2.0 * gradient


class Hides(Loop):
    """A tensor that only a function of its own is given."""

    def __init__(self, given: dict[str, Tensor]) -> None:
        super().__init__(given)
        self.hidden = torch.ones(2, dtype=D, requires_grad=True)

    def __call__(self, now: Now, given: tuple[Tensor, float]) -> tuple[Now, tuple[Tensor, ...]]:
        return super().__call__(now._replace(x=now.x + _Twice.apply(self.hidden)), given)


class Late(Loop):
    """A tensor that is used later."""

    def __init__(self, given: dict[str, Tensor]) -> None:
        super().__init__(given)
        self.late = torch.ones(2, dtype=D, requires_grad=True)

    def __call__(self, now: Now, given: tuple[Tensor, float]) -> tuple[Now, tuple[Tensor, ...]]:
        return super().__call__(now._replace(x=now.x + self.late) if int(now.count) > 2 else now, given)


@pytest.mark.parametrize("loop", [Hides, Late])
def test_no_gradient_is_lost_unsaid(loop: type[Loop]) -> None:
    total = ran(tensors(D), True, loop)
    with pytest.raises(GradientError, match=r"^a checkpointed loop lost a tensor \(2,\) that asks for a gradient: "):
        total.backward()


def test_there_are_no_second_derivatives() -> None:
    given = tensors(D)
    with pytest.raises(GradientError, match="has no second derivatives; checkpointed=False keeps what they need"):
        torch.autograd.grad(ran(given, True), given["leaf"], create_graph=True)


def test_what_was_written_into_meanwhile_is_told() -> None:
    given = tensors(D)
    total = ran(given, True)
    with torch.no_grad():
        given["leaf"].mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()
