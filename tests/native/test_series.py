"""What is alike on several slices: written once, in a loop over them, and equal to what torch does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.native import source
from apcc_torch.native.alike import formulas
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.layout import Layout, laid_out
from apcc_torch.native.ordering import ordered
from apcc_torch.native.series import Series
from apcc_torch.native.trace import Trace, traced
from apcc_torch.repetition import repeated
from laws import generator

D = torch.float64
WEIGHTS = torch.linspace(0.5, 2.5, 36, dtype=D).reshape(6, 6)


def normal(*shape: int, g: torch.Generator | None = None) -> Tensor:
    return torch.randn(shape, generator=g or generator(0), dtype=D)


class Chain(nn.Module):
    """Frames along a chain, as sections make them: alike by slice, then one after the other, then weighed."""

    def __init__(self, n: int) -> None:
        super().__init__()
        self.register_buffer("weights", torch.linspace(0.3, 1.7, 3 * n, dtype=D))

    def forward(self, x: Tensor, on: Tensor) -> tuple[Tensor, ...]:
        K = torch.linalg.cross(torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3), x.unsqueeze(-2), dim=-1)
        R = torch.eye(3, dtype=x.dtype) + K @ K + K * x.sin().unsqueeze(-1)
        ends = [R[0]]
        for k in range(1, R.shape[0]):
            ends.append(ends[-1] @ R[k])
        J = torch.stack(ends)
        J = torch.where(on[:, None, None], J, 0.5 * J.mT).flatten(0, 1)
        N = J.mT @ (self.weights.unsqueeze(-1) * J) + torch.eye(3, dtype=x.dtype)
        L, _ = torch.linalg.cholesky_ex(N)
        step = torch.cholesky_solve(J.mT[:, :4], L)
        return J, L, step, (J @ step).amax(-1), on & (x[:, 0] > 0)


class Relaxed(nn.Module):
    """A loop whose body is alike by slice, with what does not change from before it."""

    def forward(self, A: Tensor, x: Tensor) -> Tensor:
        B = A / (1.0 + A.abs().sum((-2, -1), keepdim=True))
        return repeated(lambda y: (B @ y.unsqueeze(-1)).squeeze(-1) + x.flip(0), x, 5, lambda y: y[:, 0] < 9.0)


def series(layout: Layout) -> list[Series]:
    return [statement for part in layout.parts for statement in part.statements if isinstance(statement, Series)]


def statements(layout: Layout) -> int:
    return sum(len(s.formulas) if isinstance(s, Series) else 1 for p in layout.parts for s in p.statements)


def chain(n: int) -> tuple[Chain, tuple[Tensor, Tensor]]:
    return Chain(n), (normal(n, 3), torch.arange(n) % 2 == 0)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_chain_is_what_torch_makes_of_it(n: int) -> None:
    module, example = chain(n)
    fast, g = NativeFunction(module, example), generator(n)
    for _ in range(20):
        x, on = normal(n, 3, g=g), torch.rand(n, generator=g) > 0.5
        for made, expected in zip(fast(x, on), module(x, on), strict=True):
            torch.testing.assert_close(made, expected, rtol=1e-12, atol=1e-12)


def test_a_loop_of_slices_is_what_torch_makes_of_it() -> None:
    module = Relaxed()
    fast, g = NativeFunction(module, (normal(4, 3, 3), normal(4, 3))), generator(3)
    for _ in range(20):
        A, x = normal(4, 3, 3, g=g), normal(4, 3, g=g)
        torch.testing.assert_close(fast(A, x), module(A, x), rtol=1e-13, atol=1e-13)


def test_it_is_as_exact_as_one_statement_after_the_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The same operations in another order of slices: not a bit differs."""
    module, example = chain(3)
    given = example[0] * 1.3, ~example[1]
    together = NativeFunction(module, example)(*given)
    whole = source.body
    monkeypatch.setattr(source, "body", lambda trace, together: whole(trace, together=False))
    monkeypatch.setenv("APCC_CACHE", str(tmp_path))
    apart = NativeFunction(module, example)(*given)
    assert all(torch.equal(a, b) for a, b in zip(together, apart, strict=True))


def _product(a: Tensor, b: Tensor) -> Tensor:
    return a @ b


def _sums(a: Tensor, b: Tensor) -> Tensor:
    return (2.0 * a + b.mT).square() - a


def _weighed(a: Tensor, b: Tensor) -> Tensor:
    return a.mT @ (WEIGHTS @ b)


@pytest.mark.parametrize(("function", "least"), [(_product, 6), (_sums, 30), (_weighed, 6)])
def test_sections_are_written_once(function: Callable[[Tensor, Tensor], Tensor], least: int) -> None:
    trace = traced(function, (normal(6, 6, 6), normal(6, 6, 6)))
    few, many = laid_out(trace), laid_out(trace, together=False)
    assert not series(many) and least * statements(few) < statements(many)
    assert few.operations(trace.scalars) == many.operations(trace.scalars)


def _blocks(trace: Trace) -> list[int]:
    block, _ = ordered(trace.scalars, [index for row in trace.results for index in row])
    blocks = [-1] * len(trace.scalars.expressions)
    for item in block:
        assert isinstance(item, int)
        blocks[item] = 0
    return blocks


def test_every_expression_is_computed_once_and_after_its_operands() -> None:
    trace = traced(*chain(4))
    scalars, blocks = trace.scalars, _blocks(trace)
    found = formulas(scalars, trace.calls, blocks)
    results = [index for formula in found for index in formula.results]
    assert len(results) == len(set(results)) > 0.5 * sum(block >= 0 for block in blocks)
    for formula in found:
        like = scalars[formula.results[0]]
        for place, index in enumerate(formula.results):
            operands = tuple(operand[place] for operand in formula.operands)
            assert scalars[index].op == like.op and sorted(scalars[index].operands) == sorted(operands)
    done: set[int] = set()
    for part in laid_out(trace).parts:
        for statement in part.statements:
            if isinstance(statement, int):
                assert all(_known(trace, i) or i in done for i in scalars[statement].operands)
                done.add(statement)
            elif isinstance(statement, Series):
                for place in range(statement.length):
                    own = {formula.results[place] for formula in statement.formulas}
                    own_operands = {operand[place] for formula in statement.formulas for operand in formula.operands}
                    assert all(_known(trace, i) or i in done or i in own for i in own_operands)
                done.update(index for formula in statement.formulas for index in formula.results)
    assert done == {index for index, block in enumerate(blocks) if block >= 0}


def _known(trace: Trace, index: int) -> bool:
    return trace.scalars[index].value is not None
