"""Every figure that a command writes can be read: no text overlaps another, leaves its figure, or is too small."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from matplotlib.figure import Figure

import gallery
import readable
from apcc_torch import report
from apcc_torch.report import style

DRAWINGS = dict(gallery.everything())
NO_FIGURE_OF_THEIR_OWN = {"new_figure", "warned", "curve_figure"}
"""What makes or changes a figure that others draw on."""


@pytest.mark.parametrize("name", DRAWINGS)
def test_can_be_read(name: str) -> None:
    with style.own_look():
        told = readable.faults(DRAWINGS[name]())
    assert not told, "\n".join(told)


def drawing_functions() -> Iterator[str]:
    """The names of all public functions of the reports that return a figure."""
    for module in pkgutil.iter_modules(report.__path__, f"{report.__name__}."):
        if module.name.endswith("__main__"):
            continue
        for name, function in inspect.getmembers(importlib.import_module(module.name), inspect.isfunction):
            if function.__module__ == module.name and function.__annotations__.get("return") == "Figure":
                yield f"{module.name}.{name}"


def test_all_functions_that_draw_are_in_the_gallery(monkeypatch: pytest.MonkeyPatch) -> None:
    called: set[str] = set()

    def counted(path: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            called.add(path)
            return Figure()  # what it draws is another test's matter

        return call

    wanted = {path for path in drawing_functions() if path.rpartition(".")[2] not in NO_FIGURE_OF_THEIR_OWN}
    assert len(wanted) > 20
    for path in wanted:
        module, _, name = path.rpartition(".")
        function = getattr(importlib.import_module(module), name)
        for holder in [*(importlib.import_module(m) for m in {p.rpartition(".")[0] for p in wanted}), gallery]:
            if getattr(holder, name, None) is function:
                monkeypatch.setattr(holder, name, counted(path, function))
    for draw in dict(gallery.everything()).values():
        draw()
    assert wanted <= called, f"draw {sorted(wanted - called)} in tests/gallery.py"


def test_faults_are_found() -> None:
    figure = style.new_figure(10.0, 5.0, constrained=False)
    figure.text(0.5, 0.5, "one text", fontsize=12)
    figure.text(0.52, 0.51, "another", fontsize=12)
    figure.text(0.97, 0.1, "far out of it", fontsize=12)
    figure.text(0.1, 0.9, "small", fontsize=7)
    told = readable.faults(figure)
    assert len(told) == 3
    assert any("overlaps" in each for each in told) and any("leaves" in each for each in told)
    assert any("7.8 pixels" in each for each in told)
