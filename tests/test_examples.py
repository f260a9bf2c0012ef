"""Every class and function that a room exports has an `Example:` in its docstring, and the example runs as it is."""

from __future__ import annotations

import doctest
import importlib
import inspect
import textwrap
from collections.abc import Iterator
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import gymnasium
import pytest
import torch

from apcc_torch.errors import CompileError
from apcc_torch.native.build import compiler
from apcc_torch.settings import Settings

ROOMS = ("", "lie", "native", "model", "estimation", "control", "simulation", "recordings", "envs")

AWAITED = frozenset(
    {
        "Capsule",
        "ClearanceCost",
        "Command",
        "ConstrainedVelocity",
        "ControllerState",
        "HalfSpace",
        "LawStep",
        "LengthLaw",
        "Measurement",
        "Obstacle",
        "SetPoint",
        "SineTrajectory",
        "SolverStatus",
        "Sphere",
        "Target",
        "Task",
        "TaskController",
        "TaskStack",
        "TaskTarget",
        "TendonLimits",
        "TendonReference",
        "elongation_cost",
        "ramp",
    }
)
"""Names without an example as yet; one that gets an example leaves this list."""


NEEDS = {"save_bag": "rosbags"}
"""Name -> the package that its example cannot do without."""


def room(name: str) -> ModuleType:
    return importlib.import_module(f"apcc_torch.{name}" if name else "apcc_torch")


def exported(module: ModuleType, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """What a room exports by name, and by "module.name" what modules that it exports do."""
    for name in module.__all__:
        value = getattr(module, name)
        if isinstance(value, ModuleType):
            yield from exported(value, f"{name}.")
        else:
            yield prefix + name, value


def has_own_example(value: Any) -> bool:
    """Whether a name is shown by an example of its own: settings are by that of their part, protocols by what obeys."""
    is_settings = inspect.isclass(value) and issubclass(value, Settings) and value.__name__.endswith("Settings")
    return callable(value) and not is_settings and not getattr(value, "_is_protocol", False)


PUBLIC = {name: value for each in ROOMS for name, value in exported(room(each)) if has_own_example(value)}
NAMES = {name: getattr(room(each), name) for each in ROOMS for name in room(each).__all__}
"""What examples may use besides torch and gymnasium, without importing it."""


def example_of(value: Any) -> str | None:
    """The lines below `Example:` of a docstring of its own, or None."""
    text = inspect.cleandoc(value.__dict__.get("__doc__") or "") if inspect.isclass(value) else inspect.getdoc(value)
    _, found, rest = (text or "").partition("Example:\n")
    return textwrap.dedent(rest) if found else None


def test_a_name_means_one_thing() -> None:
    for each in ROOMS:
        for name in room(each).__all__:
            assert NAMES[name] is getattr(room(each), name), name


def test_every_exported_name_has_an_example() -> None:
    assert {name for name, value in PUBLIC.items() if example_of(value) is None} == AWAITED


@pytest.mark.parametrize("name", sorted(PUBLIC.keys() - AWAITED))
def test_example_runs(name: str) -> None:
    if name == "NativeFunction":
        try:
            compiler()
        except CompileError as error:
            pytest.skip(str(error))
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    tools = {"torch": torch, "gymnasium": gymnasium, "pi": pi, "Path": Path, "TemporaryDirectory": TemporaryDirectory}
    torch.set_printoptions(profile="default")
    source = example_of(PUBLIC[name])
    assert source is not None and ">>>" in source
    test = doctest.DocTestParser().get_doctest(source, {**NAMES, **tools}, name, None, None)
    report: list[str] = []
    assert not doctest.DocTestRunner(verbose=False).run(test, out=report.append).failed, "".join(report)
