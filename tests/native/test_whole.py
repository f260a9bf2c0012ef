"""Ways to the values that a function holds: torch's operations are followed, others are refused."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.native.function import NativeFunction
from laws import worst

D = torch.float64
X = torch.tensor([0.4, -0.7], dtype=D)
pytestmark = pytest.mark.usefixtures("own_cache")


class Sees(nn.Module):
    """Reads what it holds in some way."""

    def __init__(self, how: Callable[[Tensor], Any], held: list[float]) -> None:
        super().__init__()
        self.register_buffer("held", torch.tensor(held, dtype=D))
        self.how = how

    def forward(self, x: Tensor) -> Tensor:
        return x * self.how(self.held)


def _kept(held: Tensor) -> Any:
    return held.data[0] * list(held)[1] + len(held) + held.dim() + held.detach().contiguous().sum()


def _forms(held: Tensor) -> Any:
    return torch.tensor([1.5, 0.25], dtype=held.dtype).sum() * held[held.shape[0] - 1]


def _listed(held: Tensor) -> Any:
    return held.tolist()[0]


def _branched(held: Tensor) -> Any:
    return 2.0 if held.tolist()[0] > 1.0 else 3.0


def _numpy(held: Tensor) -> Any:
    return float(held.numpy()[0])


def _array(held: Tensor) -> Any:
    return float(np.asarray(held)[0])


def _parameter(held: Tensor) -> Any:
    return nn.Parameter(held, requires_grad=False)[0]


def _made_anew(held: Tensor) -> Any:
    return torch.tensor(held.tolist(), dtype=D)[0]


def _printed(held: Tensor) -> Any:
    return len(repr(held))


def _pointer(held: Tensor) -> Any:
    return ctypes.c_double.from_address(held.data_ptr()).value


@pytest.mark.parametrize("how", [_kept, _forms])
def test_ways_to_what_is_held(how: Callable[[Tensor], Any], counted: dict[str, int]) -> None:
    for held in ([1.5, 2.0], [0.7, 2.25], [1.625, 2.5]):
        module = Sees(how, held)
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15
    assert counted == {"traced": 1, "built": 1}


@pytest.mark.parametrize("how", [_listed, _branched, _numpy, _array, _parameter, _made_anew, _printed, _pointer])
def test_values_that_are_read_past_torch_are_refused(how: Callable[[Tensor], Any]) -> None:
    with pytest.raises(CompileError, match=r"it asks for the value of a tensor|it makes a tensor of one that it holds"):
        NativeFunction(Sees(how, [1.5, 2.0]), (X,)).program(1)
