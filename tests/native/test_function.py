"""A compiled function as its users call it: batches, repetitions, tensors a row, the cache, and what it refuses."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.native import kept_program
from apcc_torch.native.build import built
from apcc_torch.native.compiled import compiled
from apcc_torch.native.function import NativeFunction
from apcc_torch.part import hold_rows
from laws import generator, normal

D = torch.float64


class State(NamedTuple):
    x: Tensor
    count: Tensor
    nothing: Tensor | None = None


class Swing(nn.Module):
    """A small step with a setting that may differ from row to row."""

    def __init__(self, rate: float | Tensor = 0.5) -> None:
        super().__init__()
        if isinstance(rate, Tensor):
            hold_rows(self, rate=(rate, 0))
        else:
            self.rate = rate

    def forward(self, state: State, push: Tensor) -> tuple[State, Tensor]:
        rate = self.rate.unsqueeze(-1) if isinstance(self.rate, Tensor) else self.rate
        x = state.x + rate * torch.sin(push - state.x)
        return State(x, state.count + (x > 0).sum(-1)), x.norm(dim=-1)


def example() -> tuple[State, Tensor]:
    return State(torch.zeros(3, dtype=D), torch.zeros((), dtype=torch.int64)), torch.zeros(3, dtype=D)


def arguments(batch: tuple[int, ...]) -> tuple[State, Tensor]:
    rng = generator(1)
    count = torch.arange(torch.Size(batch).numel()).reshape(batch)
    return State(normal((*batch, 3), D, rng), count), normal((*batch, 3), D, rng)


def same(have: tuple[State, Tensor], want: tuple[State, Tensor]) -> None:
    assert type(have[0]) is State and have[0].nothing is None
    torch.testing.assert_close(have[0].x, want[0].x, rtol=0, atol=1e-14)
    assert torch.equal(have[0].count, want[0].count)
    torch.testing.assert_close(have[1], want[1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (3, 7), (0,)])
@pytest.mark.parametrize("threads", [1, 3])
def test_any_batch(batch: tuple[int, ...], threads: int) -> None:
    module = Swing()
    step = NativeFunction(module, example(), threads=threads)
    same(step(*arguments(batch)), module(*arguments(batch)))


class Widths(nn.Module):
    """Tensors of all widths, through and back."""

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        return tuple(2.0 * x for x in given)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_rows_of_any_width_and_nothing_beside_them(dtype: torch.dtype) -> None:
    widths = (1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 27)
    step = NativeFunction(Widths(), tuple(torch.zeros(n, dtype=dtype) for n in widths))
    for rows in (2, 5, 8, 16, 19):
        given = [normal((rows, n), dtype, generator(n)) for n in widths]
        # Results amid memory that is not theirs.
        around = [torch.full((40 + rows * n,), 7.0, dtype=dtype) for n in widths]
        results = [whole[20 : 20 + rows * n].view(rows, n) for whole, n in zip(around, widths, strict=True)]
        step.threads = 1 + rows % 3
        step.bound(given, results)()
        for whole, result, x in zip(around, results, given, strict=True):
            assert torch.equal(result, 2.0 * x)
            assert whole[:20].eq(7.0).all() and whole[-20:].eq(7.0).all()
        shared = step(given[0], *(x[0] for x in given[1:]))
        assert torch.equal(shared[-1], (2.0 * given[-1][:1]).expand(rows, -1))


def doubled(x: Tensor) -> Tensor:
    """A function of this file."""
    return x + x


def test_functions_of_a_file() -> None:
    x = normal((5, 3), D, generator(6))
    assert torch.equal(NativeFunction(doubled, (x[0],))(x), 2.0 * x)


def test_what_may_hold_anything_is_refused() -> None:
    held = torch.ones(3)
    with pytest.raises(CompileError, match=r"a function that a file defines by name; got <function .*lambda"):
        NativeFunction(lambda x: x + held, (held,))
    with pytest.raises(CompileError, match="a module, a method of one"):
        NativeFunction(torch.sin, (held,))


def test_leading_dimensions_broadcast() -> None:
    module = Swing()
    step = NativeFunction(module, example())
    state, _ = arguments((4,))
    push = normal((3,), D, generator(2))
    same(step(state, push), module(state, push))
    wide = normal((2, 1, 3), D, generator(3))
    have, length = step(state, wide)
    assert length.shape == (2, 4)
    torch.testing.assert_close(have.x, module(state, wide)[0].x)


def test_strided_arguments() -> None:
    module = Swing()
    state, push = arguments((6,))
    turned = State(state.x.mT.contiguous().mT, state.count), push.flip(0).flip(0)[..., [2, 1, 0]]
    same(NativeFunction(module, example())(*turned), module(*turned))


def test_repeats_carry_the_state() -> None:
    module = Swing()
    step = NativeFunction(module, example(), carries=True)
    state, push = arguments((9,))
    want = state, push
    for _ in range(4):
        want = module(want[0], push)
    same(step(state, push, repeats=4), want)
    with pytest.raises(ValueRangeError, match="repeats must be 1"):
        NativeFunction(module, example())(state, push, repeats=2)
    with pytest.raises(ValueRangeError, match="repeats"):
        step(state, push, repeats=0)


def test_a_setting_a_row() -> None:
    rates = torch.linspace(0.1, 0.9, 6, dtype=D)
    module = Swing(rates)
    state, push = arguments((6,))
    step = NativeFunction(module, example())
    same(step(state, push), module(state, push))
    # Read at each call, and another batch of settings needs no other library.
    module.rate.mul_(0.5)
    same(step(state, push), module(state, push))


def test_bad_rows_stay_alone() -> None:
    step = NativeFunction(Swing(), example())
    state, push = arguments((11,))
    clean, _ = step(state, push)
    state.x[4] = torch.nan
    dirty, _ = step(state, push)
    others = torch.arange(11) != 4
    assert torch.equal(dirty.x[others], clean.x[others]) and dirty.x[4].isnan().all()


def test_refusals() -> None:
    step = NativeFunction(Swing(), example())
    state, push = arguments((2,))
    with pytest.raises(ShapeError, match="takes 3 tensors, got 2"):
        step(state)
    with pytest.raises(ShapeError, match=r"takes \(\.\.\., 3\) where it got \(2, 4\)"):
        step(state, torch.zeros(2, 4, dtype=D))
    with pytest.raises(DtypeError, match=r"float64 where it got torch\.float32"):
        step(state, push.float())
    with pytest.raises(ValueRangeError, match="no gradient"):
        step(state, push.requires_grad_())
    with pytest.raises(CompileError, match="not a list"):
        step(state, [push])

    class Grows(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return torch.cat((x, x))

    with pytest.raises(CompileError, match="must come back as it went in"):
        NativeFunction(Grows(), (push.detach()[0],), carries=True)


def test_libraries_are_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("APCC_CACHE", str(tmp_path))
    state, push = arguments((5,))
    want = NativeFunction(Swing(0.25), example())(state, push)

    def never(*_: object) -> None:
        raise AssertionError("built again")

    monkeypatch.setattr(kept_program, "built", never)
    same(NativeFunction(Swing(0.25), example())(state, push), want)
    # Another number is read by the same code.
    same(NativeFunction(Swing(0.26), example())(state, push), Swing(0.26)(state, push))
    with pytest.raises(AssertionError, match="built again"):
        NativeFunction(Swing(torch.tensor([0.25], dtype=D)), example())(state, push)
    # Of a setting a row only the form counts.
    monkeypatch.setattr(kept_program, "built", built)
    NativeFunction(Swing(torch.tensor([0.25], dtype=D)), example())(state, push)
    monkeypatch.setattr(kept_program, "built", never)
    NativeFunction(Swing(torch.tensor([0.4] * 5, dtype=D)), example())(state, push)


def test_without_a_compiler_a_step_runs_eagerly(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with caplog.at_level(logging.WARNING):
        step = compiled(Swing(), example(), "auto", rows=4, carries=True)
    (record,) = caplog.records
    assert record.getMessage() == (
        "Swing is not compiled and runs eagerly: no C++ compiler: no-such-compiler is on the path; "
        "install g++ or set CXX"
    )
    state, push = arguments((4,))
    same(step(state, push, repeats=1), Swing()(state, push))


@pytest.mark.parametrize("mode", ["off", "aot", "auto"])
def test_modes_agree(mode: str) -> None:
    state, push = arguments((4,))
    step = compiled(Swing(), example(), mode, rows=4, carries=True)
    want = state, push
    for _ in range(3):
        want = Swing()(want[0], push)
    same(step(state, push, repeats=3), want)


def test_unknown_mode() -> None:
    with pytest.raises(ValueRangeError, match="compile must be one of off, inductor, aot, auto, got 'jit'"):
        compiled(Swing(), example(), "jit")


def test_one_tensor_given_twice() -> None:
    class Two(nn.Module):
        def forward(self, x: Tensor, y: Tensor) -> Tensor:
            return x - 2.0 * y

    same_one = torch.zeros(2, dtype=D)
    x, y = normal((3, 2), D, generator(4)), normal((3, 2), D, generator(5))
    torch.testing.assert_close(NativeFunction(Two(), (same_one, same_one))(x, y), x - 2.0 * y)
