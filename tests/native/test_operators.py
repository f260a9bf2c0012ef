"""Every tensor operation as machine code against torch itself, in plain numbers and in lanes, bad values included."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.native import trace
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.operators import MOVES, OPERATORS
from apcc_torch.native.values import Operator
from laws import generator, normal

INDEX = torch.tensor([2, 0, 1])

# x (3, 4) of any sign, p (3, 4) positive, A (2, 3, 3) positive definite, c (3, 4) truth values, v (3,).
CASES: dict[str, Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], object]] = {
    "sums": lambda x, p, A, c, v: (x + p, x - 2.0 * p, torch.add(x, p, alpha=3.0), 1.0 - x, x + 1, torch.sub(x, v[0])),
    "products": lambda x, p, A, c, v: (x * p, x / p, p.reciprocal(), 2.0 / p, -x, x * 0.0 + 1.0, x.square(), x * -1.0),
    "fused": lambda x, p, A, c, v: (torch.addcmul(x, p, x, value=-0.5), torch.lerp(x, p, 0.3), torch.lerp(x, p, p)),
    "powers": lambda x, p, A, c, v: (p**0.5, x**2, x**3, p**1.7, p.sqrt(), p.log(), x.exp(), torch.expm1(x),
                                    torch.pow(2.5, x), p**x),
    "angles": lambda x, p, A, c, v: (x.sin(), x.cos(), (1e4 * x).sin(), (1e7 * p).cos(), torch.atan2(x, p), x.tanh(),
                                    x.tan(), x.asin(), p.acos(), x.atan(), p.rsqrt()),
    "steps": lambda x, p, A, c, v: (x.abs(), x.floor(), torch.relu(x), torch.threshold(x, 0.2, 9.0)),
    "bounds": lambda x, p, A, c, v: (x.clamp(-0.3, 0.4), x.clamp(min=0.1), x.clamp(max=p), torch.maximum(x, p),
                                    torch.minimum(x, -p), x.clamp_min(0.1), x.clamp_max(0.1)),
    "comparisons": lambda x, p, A, c, v: (x < p, x <= 0.0, x > p, x >= 0.0, x == x, x != p, torch.isfinite(x / v[0]),
                                         torch.isnan(x)),
    "logic": lambda x, p, A, c, v: (c & (x > 0), c | (x > 0), ~c, torch.logical_and(c, x > 0), torch.logical_not(c),
                                   c & True, c.any(-1), c.all(0), c.any(), (~c).all(), c.any().all(),
                                   torch.logical_or(c, x > 0)),
    "choices": lambda x, p, A, c, v: (torch.where(c, x, p), torch.where(c, x, 0.0), x.masked_fill(c, torch.nan),
                                     torch.where(~c, 1.0, x), torch.where(c, c, x > 0)),
    "reductions": lambda x, p, A, c, v: (x.sum(), x.sum(-1), x.sum((0, 1)), x.sum(0, keepdim=True), x.mean(-1),
                                        p.prod(-1), x.amax(-1), x.amin((0, 1)), x.norm(dim=-1), x.cumsum(0), v[0].sum(),
                                        torch.linalg.vector_norm(x, dim=(0, 1)), c.sum(-1), x[:, :0].sum(-1)),
    "places": lambda x, p, A, c, v: (x.argmax(-1), x.argmin(0), x.gather(-1, x.argmax(-1, keepdim=True)),
                                    x.diff(dim=-1),
                                    x.index_select(0, INDEX), x[INDEX], x.gather(0, INDEX[:, None].expand(3, 4))),
    "shapes": lambda x, p, A, c, v: (x.mT, x.flatten(), x.unflatten(-1, (2, 2)), x[..., 1:3], x[..., None, :],
                                    x.view(12), torch.cat((x, p), 0), torch.stack((x, p), -1), x.unbind(0)[1],
                                    x.split(2, -1)[1], x.movedim(0, 1).reshape(2, 6), x.expand(2, 3, 4), x.flip(0),
                                    A.transpose(0, 2),
                                    torch.stack((c, x > 0)), x.repeat(2, 1), x.narrow(1, 1, 2), x.squeeze(0)),
    "diagonals": lambda x, p, A, c, v: (A.diagonal(dim1=-2, dim2=-1), torch.diag_embed(v), A.tril(), A.triu(1),
                                       torch.diagonal_scatter(A[0], v), torch.nn.functional.pad(x, (0, 1), value=2.0)),
    "made": lambda x, p, A, c, v: (torch.zeros_like(x) + v[0], torch.ones_like(x) * p, torch.full_like(x, 3.0),
                                  torch.eye(3, dtype=x.dtype) @ A, torch.arange(4, dtype=x.dtype) * x,
                                  torch.zeros(2, dtype=x.dtype), torch.full((2,), v.shape[0], dtype=torch.int64),
                                  torch.ones(2, dtype=x.dtype), x.new_zeros((2, 3)) - v[0],
                                  torch.tensor([1.0, 2.0, 3.0], dtype=x.dtype) + v),
    # What is written into a part, or into it seen in another shape, is in the whole.
    "written": lambda x, p, A, c, v: (y := x.clone(), y[:, 1].copy_(p[:, 0]), y.view(12)[6:8].copy_(v[:2]),
                                     z := A.mT.contiguous().mT, z.diagonal(dim1=-2, dim2=-1).copy_(v.expand(2, 3))),
    "kinds": lambda x, p, A, c, v: (c.to(x.dtype) * x, (3.0 * x).to(torch.int64), c.to(torch.int64) + 1, c * x,
                                   torch.where(c, 3, 4).to(x.dtype), x.to(torch.bool), torch.stack((c.to(x.dtype), x))),
    "linear algebra": lambda x, p, A, c, v: (A @ A, A @ v, x.mT @ x, v @ x, torch.linalg.cross(x[:, 0], v),
                                            torch.linalg.cross(x, p, dim=0), torch.bmm(A, A), torch.mv(A[0], v),
                                            torch.mm(x, x.mT), torch.einsum("kij,kjl->il", A, A)),
    "factors": lambda x, p, A, c, v: (torch.linalg.cholesky_ex(A)[0], torch.cholesky_solve(
        x[:, :2].expand(2, 3, 2), torch.linalg.cholesky_ex(A)[0]),
        torch.linalg.solve_ex(A - 1.0, x[:, :2].expand(2, 3, 2))[0]),
}  # fmt: skip


class Case(nn.Module):
    """One line of the table as a module."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def forward(self, x: Tensor, p: Tensor, A: Tensor, c: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        return tuple(CASES[self.name](x, p, A, c, v))  # type: ignore[arg-type]


def rows(dtype: torch.dtype, count: int) -> tuple[Tensor, ...]:
    rng = generator(0)
    x = normal((count, 3, 4), torch.float64, rng)
    x[0, 0, 0], x[1, 0, 1], x[2] = torch.nan, torch.inf, 0.0
    half = normal((count, 2, 3, 3), torch.float64, rng)
    A = half @ half.mT + 0.5 * torch.eye(3)
    p = normal((count, 3, 4), torch.float64, rng).abs() + 0.1
    c = normal((count, 3, 4), torch.float64, rng) > 0
    v = normal((count, 3), torch.float64, rng)
    return x.to(dtype), p.to(dtype), A.to(dtype), c, v.to(dtype)


class Table(nn.Module):
    """The whole table as one module."""

    def forward(self, *given: Tensor) -> tuple[tuple[Tensor, ...], ...]:
        return tuple(Case(name)(*given) for name in CASES)


@cache
def compiled_rows(dtype: torch.dtype) -> tuple[dict[str, tuple[Tensor, ...]], dict[str, tuple[Tensor, ...]]]:
    """What machine code makes of every case: of eleven rows in lanes, and of the sixth alone in plain numbers."""
    inputs = rows(dtype, 11)
    compiled = NativeFunction(Table(), tuple(value[3] for value in inputs))
    together, alone = compiled(*inputs), compiled(*(value[5] for value in inputs))
    return dict(zip(CASES, together, strict=True)), dict(zip(CASES, alone, strict=True))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_operation(name: str, dtype: torch.dtype) -> None:
    case, inputs = Case(name), rows(dtype, 11)
    have, alone = (made[name] for made in compiled_rows(dtype))
    tolerance = {"rtol": 1e-12, "atol": 1e-12} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 1e-5}
    for k in range(11):
        want = case(*(value[k] for value in inputs))
        for one, other in zip(have, want, strict=True):
            assert one.dtype == other.dtype
            if k < 3 and name in ("products", "made", "linear algebra", "factors", "kinds"):
                continue  # zero times what is not finite is zero here, and no integer is infinite
            torch.testing.assert_close(one[k], other, equal_nan=True, **tolerance)
    rounding = {"rtol": 1e-14, "atol": 1e-14} if dtype == torch.float64 else {"rtol": 1e-5, "atol": 1e-6}
    for one, other in zip(alone, have, strict=True):
        torch.testing.assert_close(one, other[5], equal_nan=True, **rounding)


def test_every_rule_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = set()

    class Noted(dict[str, Operator]):
        def get(self, name: str, *default: Any) -> Any:
            seen.add(name)
            return super().get(name, *default)

    monkeypatch.setattr(trace, "OPERATORS", Noted(OPERATORS))
    for name in CASES:
        trace.traced(Case(name), tuple(v[3] for v in rows(torch.float64, 4)))
    assert OPERATORS.keys() <= seen
    assert len({name.removeprefix("aten.") for name in seen} & MOVES) > 15


def test_a_matrix_that_is_not_positive_definite_says_so() -> None:
    class Factor(nn.Module):
        def forward(self, A: Tensor) -> tuple[Tensor, Tensor]:
            factor, info = torch.linalg.cholesky_ex(A)
            return factor, info

    A = torch.diag_embed(torch.tensor([[1.0, 2.0], [1.0, -2.0]], dtype=torch.float64))
    factor, info = NativeFunction(Factor(), (A[0],))(A)
    assert torch.equal(info != 0, torch.tensor([False, True]))
    torch.testing.assert_close(factor[0], torch.linalg.cholesky(A[0]))


def test_unknown_operations_are_named() -> None:
    class Unknown(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return torch.special.bessel_j0(x)

    with pytest.raises(CompileError, match=r"aten.special_bessel_j0.default cannot be compiled: no rule"):
        NativeFunction(Unknown(), (torch.ones(3),))(torch.ones(3))


@pytest.mark.parametrize("asked", [lambda x: bool((x > 0).all()), lambda x: x.tolist()[0], lambda x: x.numpy()[0]])
def test_branches_on_values_are_refused(asked: Callable[[Tensor], object]) -> None:
    class Branch(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x if asked(x) else -x

    with pytest.raises(CompileError, match="cannot be traced"):
        NativeFunction(Branch(), (torch.ones(3),))(torch.ones(3))


def test_what_the_function_holds_is_not_written_into() -> None:
    class Counts(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("count", torch.zeros(3))

        def forward(self, x: Tensor) -> Tensor:
            return self.count.copy_(x)

    module = Counts()
    module(torch.ones(3))
    with pytest.raises(CompileError, match=r"aten.copy_.default cannot be compiled: it writes into what .* holds"):
        NativeFunction(module, (torch.full((3,), 2.0),))(torch.ones(3))
