"""Gradients as machine code: torch's own, operation by operation and through the arm's mechanics."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from apcc_torch import Arm
from apcc_torch.errors import CompileError, GradientError
from apcc_torch.native.gradient import DifferentiableFunction
from apcc_torch.part import hold_rows
from apcc_torch.repetition import repeated
from laws import generator, normal

D = torch.float64


def smooth(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Every operation that has a slope, where it has one."""
    low = 0.4 * torch.tanh(x)
    first = torch.stack([
        x * y - y / (2.0 + x.square()), x.sin() + y.cos() * x.exp(), torch.atan2(x, y), (1.0 + x.square()).sqrt(),
        low.asin() + low.acos() * y, x.atan() + low.tan(), torch.expm1(x) + (2.0 + low).log(), (1.5 + low) ** (0.3 * y),
        (2.0 + low) ** 2.5, -x.abs() * y, torch.where(x > y, x * y, x + y), torch.maximum(x, y),
        x.clamp(-0.3, 0.4) - torch.minimum(x, 2.0 * y), x.floor() * y,
    ])  # fmt: skip
    return first, x.norm() * y.sum() + torch.linalg.vector_norm(torch.stack([x, y]))


class Counts(nn.Module):
    """Integers and truth values among arguments and results, and what nothing depends on."""

    def forward(self, now: tuple[Tensor, Tensor], x: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor]:
        y, count = now
        return count + 1, (torch.where(count > 1, x * y, x), x > y), torch.ones_like(x)


@pytest.mark.parametrize("batch", [(), (9,), (2, 3)])
def test_every_operation(batch: tuple[int, ...]) -> None:
    rng = generator(2)
    x, y = (normal((*batch, 4), D, rng).requires_grad_() for _ in range(2))
    step = DifferentiableFunction(smooth, (x.detach().reshape(-1, 4)[0], y.detach().reshape(-1, 4)[0]))
    flat = [v.reshape(-1, 4) for v in (x, y)]
    eager = [torch.stack(each).reshape((*batch, *each[0].shape)) for each in zip(*map(smooth, *flat), strict=True)]
    have = step(x, y)
    weights = [normal(leaf.shape, D, rng) for leaf in eager]
    for a, b in zip(have, eager, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    totals = [sum((w * leaf).sum() for w, leaf in zip(weights, leaves, strict=True)) for leaves in (have, eager)]
    for a, b in zip(*(torch.autograd.grad(total, (x, y)) for total in totals), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


def test_what_rows_share_gets_the_sum_and_integers_nothing() -> None:
    y, x = normal((3,), D, generator(1)).requires_grad_(), normal((5, 3), D, generator(2)).requires_grad_()
    count = torch.arange(5)
    step = DifferentiableFunction(Counts(), ((torch.zeros(3, dtype=D), torch.tensor(0)), torch.zeros(3, dtype=D)))
    later, (product, larger), ones = step((y, count), x)
    assert torch.equal(later, count + 1) and torch.equal(larger, x > y) and not later.requires_grad
    weight = normal((5, 3), D, generator(3))
    eager = torch.where(count.unsqueeze(-1) > 1, x * y, x)
    have = torch.autograd.grad((weight * product).sum() + ones.sum(), (y, x))
    for a, b in zip(have, torch.autograd.grad((weight * eager).sum(), (y, x)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("dtype", "close"), [(D, 1e-11), (torch.float32, 2e-4)])
def test_the_dynamics_of_an_arm(dtype: torch.dtype, close: float) -> None:
    dynamics = Arm(lengths=[0.2, 0.25], mass=0.4).dynamics().to(dtype)
    rng = generator(5)
    scale = torch.tensor([0.5, 0.5, 0.02] * 2, dtype=dtype)
    given = [(scale * normal((7, 6), dtype, rng)).requires_grad_() for _ in range(3)]
    step = DifferentiableFunction(dynamics, tuple(leaf.detach()[0] for leaf in given))
    have, want = step(*given), dynamics(*given)
    weight = normal(want.shape, dtype, rng) / want.detach().abs().max()
    torch.testing.assert_close(have, want, rtol=close, atol=close * float(want.detach().abs().max()))
    slopes = (torch.autograd.grad((weight * result).sum(), given) for result in (have, want))
    for a, b in zip(*slopes, strict=True):
        torch.testing.assert_close(a, b, rtol=close, atol=close * float(b.abs().max()))


def test_what_it_cannot_do_is_said() -> None:
    x = torch.tensor([0.3], dtype=D, requires_grad=True)

    class Rows(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            hold_rows(self, rate=(torch.ones(4, dtype=D), 0))

        def forward(self, x: Tensor) -> Tensor:
            return self.rate.unsqueeze(-1) * x

    with pytest.raises(CompileError, match="takes no settings that differ from row to row"):
        DifferentiableFunction(Rows(), (x.detach(),))

    class Repeats(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return repeated(lambda x: 0.5 * x, x, 3, lambda x: x > 0.1)

    with pytest.raises(CompileError, match="repeated on its own result has no gradient in machine code"):
        DifferentiableFunction(Repeats(), (x.detach(),))(x).backward()
    (result,) = DifferentiableFunction(Counts(), ((x.detach(), torch.tensor(0)), x.detach()))((x, torch.tensor(3)), x)[
        1
    ][:1]
    with pytest.raises(GradientError, match="has no second derivatives: call the module itself"):
        torch.autograd.grad(result, x, create_graph=True)
