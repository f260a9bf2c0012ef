"""The common look: files are whole, colours are fixed, scales follow the data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from apcc_torch.report import style


def test_saves_at_the_size_asked_for_and_leaves_no_draft(tmp_path: Path) -> None:
    path = style.save_figure(style.new_figure(4.0, 3.0), tmp_path / "new" / "a.png", dpi=50)
    assert Image.open(path).size == (200, 150)
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


@pytest.mark.parametrize("suffix", [".pdf", ".svg", ".png"])
def test_the_suffix_names_the_format(tmp_path: Path, suffix: str) -> None:
    path = style.save_figure(style.new_figure(2.0, 2.0), tmp_path / f"a{suffix}")
    head = path.read_bytes()[:200]
    assert {".pdf": b"%PDF", ".svg": b"<?xml", ".png": b"\x89PNG"}[suffix] in head


def test_save_figures_names_every_file(tmp_path: Path) -> None:
    drawings = dict.fromkeys(("a.png", "b.png"), lambda: style.new_figure(1, 1))
    paths = style.save_figures(drawings, tmp_path, dpi=20)
    assert [p.name for p in paths] == ["a.png", "b.png"] and all(p.is_file() for p in paths)


def _drawn() -> Figure:
    figure = style.new_figure(3.0, 2.0)
    style.dress(figure.subplots(), "x (m)", "y (m)", "title")
    return figure


def test_figures_have_the_one_look_whatever_a_users_matplotlibrc_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (ours,) = style.save_figures({"a.png": _drawn}, tmp_path / "ours")
    others = {"text.usetex": True, "font.family": ["no such font"], "savefig.bbox": "tight", "axes.grid": True}
    for name, value in others.items():
        monkeypatch.setitem(rcParams, name, value)
    (theirs,) = style.save_figures({"a.png": _drawn}, tmp_path / "theirs")
    assert theirs.read_bytes() == ours.read_bytes() and rcParams["text.usetex"]


def test_a_figure_that_fails_is_told_and_the_others_go_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def fails() -> Figure:
        raise RuntimeError("no such thing\nmore about it")

    drawings = {"a.png": fails, "b.png": _drawn}
    assert [path.name for path in style.save_figures(drawings, tmp_path)] == ["b.png"]
    assert caplog.messages == ["a.png is not drawn: no such thing"]
    (tmp_path / "taken").write_text("")
    told: list[str] = []
    with style.failures_told(told.append):
        assert style.save_figures({"b.png": _drawn}, tmp_path / "taken") == []
    assert len(told) == 1 and told[0].startswith("b.png is not drawn: ") and len(caplog.messages) == 1


def test_faded_mixes_with_white() -> None:
    assert style.faded("#204060", 1.0) == pytest.approx(to_rgb("#204060"))
    assert style.faded("#204060", 0.0) == pytest.approx((1.0, 1.0, 1.0))
    assert style.faded("black", 0.25) == pytest.approx((0.75, 0.75, 0.75))


@pytest.mark.parametrize(("value", "text"), [(1.3, "1.30"), (0.04123, "0.0412"), (123.4, "123"), (0.0, "0.00")])
def test_digits(value: float, text: str) -> None:
    assert style.digits(value) == text


def test_log_scale_bounds_the_decades_and_survives_zeros() -> None:
    ax = style.new_figure().subplots()
    style.log_scale(ax, [np.array([0.0, 1e-9, 1.0, 50.0]), np.array([np.nan])], decades=3.0)
    low, high = ax.get_ylim()
    assert ax.get_yscale() == "log" and high > 50.0 and 1e-2 <= low <= 0.1
    flat = style.new_figure().subplots()
    style.log_scale(flat, [np.zeros(3)])
    assert flat.get_yscale() == "linear"


def test_nothing_global_changes(tmp_path: Path) -> None:
    before = dict(rcParams)
    figure = style.new_figure()
    style.dress(figure.subplots(), "x (m)", "y (m)", "title")
    style.save_figure(figure, tmp_path / "a.png", dpi=30)
    assert dict(rcParams) == before


def _luminance(color: str) -> float:
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def _deuteranope(color: str) -> np.ndarray:
    """How the colour looks without the green receptors, after Machado, Oliveira and Fernandes (2009)."""
    seen = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    rgb = np.array(to_rgb(color))
    return seen @ np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def test_controllers_are_told_apart_without_green_receptors() -> None:
    a, b = (_deuteranope(style.CONTROLLERS[name]) for name in ("standard", "adaptive"))
    assert np.linalg.norm(a - b) > 0.4


def test_text_is_readable_on_white() -> None:
    assert all(1.05 / (_luminance(color) + 0.05) > 4.5 for color in (style.INK, style.MUTED))
