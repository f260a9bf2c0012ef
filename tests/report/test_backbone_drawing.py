"""The stroboscopic comparison draws every moment of every controller, from both angles, and the target."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.errors import ShapeError
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import VIEWS, Snapshots, spread_indices, stroboscopic_figure
from apcc_torch.report.hero import hero_figure
from apcc_torch.report.space import Camera


def some(shots: Snapshots, at: list[int]) -> Snapshots:
    return Snapshots(*(field[at] for field in shots[:5]), target=shots.target[-1])  # type: ignore[index]


def test_rows_views_and_columns(moments: Snapshots, tmp_path: Path) -> None:
    shots = some(moments, [0, 20, 40])
    figure = stroboscopic_figure({"standard": shots, "adaptive": shots}, title="a run")
    assert len(figure.axes) == 2 * 2 * 3
    texts = [text.get_text() for text in figure.texts]
    assert {"standard, view 1", "standard, view 2", "adaptive, view 1", "adaptive, view 2"} <= set(texts)
    for row in range(4):
        camera = Camera(*VIEWS[row % 2])
        true, model, both = figure.axes[3 * row : 3 * row + 3]
        tips = camera.project(shots.true_points[:, -1].numpy())
        drawn = [line.get_xydata()[-1] for line in true.lines if len(line.get_xdata()) == 30]
        assert np.array(drawn) == pytest.approx(tips)
        assert sum(len(line.get_xdata()) == 25 for line in model.lines) == 3
        assert sum(len(line.get_xdata()) in (25, 30) for line in both.lines) == 6
        for ax in (true, model, both):
            (star,) = [line for line in ax.lines if line.get_marker() == "*"]
            assert star.get_xydata()[0] == pytest.approx(camera.project(shots.target.numpy()))
        (dots,) = [line for line in true.lines if line.get_marker() == "o"]
        assert dots.get_xydata() == pytest.approx(camera.project(shots.true_markers.numpy()).reshape(-1, 2))
    assert style.save_figure(figure, tmp_path / "a.png", dpi=30).is_file()


def test_works_without_target_and_markers(moments: Snapshots) -> None:
    shots = some(moments, [40])
    bare = shots._replace(target=None, true_markers=torch.zeros(1, 0, 3), model_markers=torch.zeros(1, 0, 3))
    figure = stroboscopic_figure({"standard": bare}, views=VIEWS[:1])
    assert len(figure.axes) == 3


def test_bad_moments_are_named(moments: Snapshots) -> None:
    with pytest.raises(ShapeError, match=r"adaptive\.model_points"):
        stroboscopic_figure({"adaptive": moments._replace(model_points=moments.model_points[1:])})


def test_spread_indices() -> None:
    time = torch.linspace(0.0, 10.0, 101)
    assert spread_indices(time, 0.0, 3.0, 4) == [0, 10, 20, 30]
    assert spread_indices(time, 0.0, 99.0, 2) == [0, 100]
    assert spread_indices(time, 0.0, 0.01, 5) == [0]


def test_hero(moments: Snapshots, tmp_path: Path) -> None:
    shots = some(moments, [10, 25, 40])
    models = {"fixed model": shots.model_points, "adapted model": shots.true_points}
    errors = {"fixed model": torch.full((41,), 0.02), "adapted model": torch.linspace(0.02, 0.001, 41)}
    figure = hero_figure(shots.true_points, models, shots.true_markers, moments.time, errors, path=moments.target)
    space, curves = figure.axes
    for line, error in zip(curves.lines, errors.values(), strict=True):
        assert line.get_ydata() == pytest.approx(1e3 * error.numpy())
    tips = Camera().project(shots.true_points[:, -1].numpy())
    ends = np.array([line.get_xydata()[-1] for line in space.lines])
    assert all(np.isclose(ends, tip).all(-1).any() for tip in tips)
    assert style.save_figure(figure, tmp_path / "hero.png", dpi=40).is_file()
