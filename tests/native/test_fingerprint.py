"""What a module's code depends on: its source wherever it is, the functions and settings that it holds."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apcc_torch import Arm
from apcc_torch.native.function import NativeFunction
from laws import worst

D = torch.float64
X = torch.tensor([0.4, -0.7], dtype=D)
pytestmark = pytest.mark.usefixtures("own_cache")


SESSION = """
from torch import nn

class Made(nn.Module):
    def forward(self, x):
        return {factor} * x
"""


@pytest.mark.parametrize("named", [{}, {"__name__": "a_session"}])
def test_what_a_session_made_is_traced_each_time(named: dict[str, str], own_cache: Path) -> None:
    for factor in (1.3, 1.7):
        session: dict[str, Any] = dict(named)
        exec(SESSION.format(factor=factor), session)
        for _ in range(2):
            assert torch.equal(NativeFunction(session["Made"](), (X,))(X), factor * X)
    assert not list(own_cache.glob("*.json")) and len(list(own_cache.glob("*.so"))) == 1


MINE = """
import torch
from torch import nn
import their_{n}
from their_{n} import helped

FACTOR = 1.3
WEIGHTS = torch.tensor([0.7, 0.9]).double()

class Base(nn.Module):
    share = 0.5

class Made(Base):
    def forward(self, x):
        return helped(x) + FACTOR * WEIGHTS * x + self.share + their_{n}.inner(x)
"""
THEIR = """
def helped(x):
    return {slope} * x

def inner(x):
    return x.sin()
"""


def test_code_from_elsewhere_counts_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counted: dict[str, int]
) -> None:
    """A helper in another file, a global, a tensor beside the class: each is told apart."""
    monkeypatch.syspath_prepend(tmp_path)
    made = []
    for n, slope in enumerate((0.25, 0.75)):
        (tmp_path / f"their_{n}.py").write_text(THEIR.format(slope=slope))
        (tmp_path / f"mine_{n}.py").write_text(MINE.format(n=n))
        made.append(importlib.import_module(f"mine_{n}"))
    mine = made[0]

    def right() -> None:
        module = mine.Made()
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15

    right()
    (tmp_path / "their_0.py").write_text(THEIR.format(slope=0.75))
    monkeypatch.setattr(mine, "helped", made[1].helped)
    right()
    monkeypatch.setattr(mine, "FACTOR", 1.4)
    right()
    assert counted["traced"] == 3
    monkeypatch.setattr(mine, "WEIGHTS", torch.tensor([0.6, 0.8]).double())
    right()
    assert counted["traced"] == 3  # of a tensor the numbers are read


def scaled_by(factor: Any) -> Callable[[Tensor], Tensor]:
    def scaled(x: Tensor, more: float = 1.0) -> Tensor:
        return factor * more * x

    return scaled


class Calls(nn.Module):
    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


class Scales:
    def __init__(self, factor: float) -> None:
        self.factor = factor

    def of(self, x: Tensor) -> Tensor:
        return self.factor * x


def test_functions_count_with_what_they_hold() -> None:
    for factor in (1.3, 1.7, torch.tensor([1.2, 1.9], dtype=D), torch.tensor([1.4, 1.8], dtype=D)):
        ways = [scaled_by(factor), partial(torch.mul, factor), partial(scaled_by(1.1), more=factor)]
        ways += [Scales(factor).of] if isinstance(factor, float) else []
        for way in ways:
            module = Calls(way)
            assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15


class Describes(nn.Module):
    """Holds a description, of which it reads some or nothing."""

    def __init__(self, arm: Arm, how: Callable[[Arm], float]) -> None:
        super().__init__()
        self.arm, self.again, self.how = arm, [arm], how

    def forward(self, x: Tensor) -> Tensor:
        return self.how(self.again[0]) * x


def _nothing(arm: Arm) -> float:
    return 1.3 if isinstance(arm, Arm) else 1.7


def _field(arm: Arm) -> float:
    return float(arm.mass)  # type: ignore[arg-type]


def _whole(arm: Arm) -> float:
    return 1.3 if arm == Arm(lengths=[0.2], mass=0.4) else 1.7


def _members(arm: Arm) -> float:
    return float(vars(arm)["lengths"][0])


@pytest.mark.parametrize(("how", "again"), [(_nothing, 0), (_field, 2), (_whole, 2), (_members, 2)])
def test_settings_count_where_they_are_read(how: Callable[[Arm], float], again: int, counted: dict[str, int]) -> None:
    for _ in range(2):
        for arm in (Arm(lengths=[0.2], mass=0.4), Arm(lengths=[0.25], mass=0.4), Arm(lengths=[0.2], mass=0.5)):
            module = Describes(arm, how)
            assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15
    assert counted["traced"] == 1 + again
