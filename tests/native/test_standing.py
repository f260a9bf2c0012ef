"""Calls on memory that stays: the same numbers as ordinary calls, of machine code and of torch, one row and many."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.native import NativeFunction, StandingCall, TorchStep
from apcc_torch.part import hold_rows
from laws import generator, normal

D = torch.float64


class State(NamedTuple):
    x: Tensor
    count: Tensor
    single: Tensor
    nothing: Tensor | None = None


class Swing(nn.Module):
    def __init__(self, rate: Tensor) -> None:
        super().__init__()
        hold_rows(self, rate=(rate, 0))

    def forward(self, state: State, push: tuple[Tensor, Tensor]) -> tuple[State, Tensor]:
        x = state.x + self.rate.unsqueeze(-1) * torch.sin(push[0] - state.x)
        x = torch.where(push[1].unsqueeze(-1), x, state.x)
        return State(x, state.count + (x > 0).sum(-1), state.single + x.sum(-1).float()), x.norm(dim=-1)


def example(batch: tuple[int, ...]) -> tuple[State, tuple[Tensor, Tensor]]:
    rng = generator(3)
    state = State(normal((*batch, 3), D, rng), torch.zeros(batch, dtype=torch.int64), torch.zeros(batch))
    return state, (normal((*batch, 3), D, rng), torch.ones(batch, dtype=torch.bool))


@pytest.mark.parametrize("batch", [(), (5,)])
@pytest.mark.parametrize("kind", ["machine code", "torch", "function"])
def test_the_numbers_of_ordinary_calls(kind: str, batch: tuple[int, ...]) -> None:
    module = Swing(torch.linspace(0.2, 0.8, 5, dtype=D) if batch else torch.tensor(0.4, dtype=D))
    state, push = example(batch)
    step = NativeFunction(module, example(())) if kind == "machine code" else TorchStep(module)
    call = StandingCall(module.forward if kind == "function" else step, (state, push), carries=True)
    rng = generator(4)
    for k in range(6):
        push = normal((*batch, 3), D, rng), torch.rand(batch, generator=rng) > 0.3
        call.given[1][0][...], call.given[1][1][...] = push[0].numpy(), push[1].numpy()
        call()
        state, length = module(state, push)
        assert type(call.results[0]) is State and call.results[0].nothing is None
        np.testing.assert_allclose(call.results[1], length.numpy(), rtol=0, atol=1e-14)
        for stands in (call.results[0], call.given[0]):
            np.testing.assert_allclose(stands.x, state.x.numpy(), rtol=0, atol=1e-14)
            assert np.array_equal(stands.count, state.count.numpy()), k
            np.testing.assert_allclose(stands.single, state.single.numpy(), rtol=0, atol=1e-6)


def test_nothing_is_carried_unless_asked() -> None:
    step = NativeFunction(Swing(torch.tensor(0.4, dtype=D)), example(()))
    call = StandingCall(step, example(()))
    before = call.given[0].x.copy()
    call()
    first = call.results[0].x.copy()
    call()
    assert np.array_equal(call.given[0].x, before) and np.array_equal(call.results[0].x, first)
    assert not np.array_equal(first, before)


def test_the_examples_own_memory_is_left_alone() -> None:
    state, push = example(())
    before = state.x.clone()
    call = StandingCall(Swing(torch.tensor(0.4, dtype=D)), (state, push), carries=True)
    for _ in range(3):
        call()
    assert torch.equal(state.x, before)


def test_a_setting_is_read_at_each_call() -> None:
    module = Swing(torch.linspace(0.2, 0.8, 5, dtype=D))
    call = StandingCall(NativeFunction(module, example(())), example((5,)))
    module.rate.mul_(0.5)
    call()
    np.testing.assert_allclose(call.results[1], module(*example((5,)))[1].numpy(), rtol=0, atol=1e-14)


def test_what_is_carried_has_one_form() -> None:
    call = StandingCall(lambda x: torch.cat((x, x)), (torch.zeros(2),), carries=True)
    with pytest.raises(CompileError, match="must come back as it went in"):
        call()
