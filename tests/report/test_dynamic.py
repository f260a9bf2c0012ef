"""Bands are the runs' own mean, minimum and maximum; legends say the means; diverged runs are counted out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.report import dynamic
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.style import CONTROLLERS, save_figure


def curves(seed: int, T: int = 21, R: int = 5, k: int = 3, adapts: bool = True) -> RunCurves:
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return 0.001 + 0.01 * torch.rand(*shape, generator=g, dtype=torch.float64)

    pi_hat = torch.tensor([0.105, 0.255, 0.24], dtype=torch.float64).expand(T, R, 3)
    pi_hat = pi_hat + draw(T, R, 3) if adapts else pi_hat
    time = torch.linspace(0.0, 10.0, T, dtype=torch.float64)
    return RunCurves(
        time,
        draw(T, R),
        draw(T, R),
        draw(T, R, k),
        draw(T, R, k),
        draw(T, R),
        pi_hat,
        draw(T, R),
        torch.zeros(T, R).long(),
    )


@pytest.fixture
def runs() -> dict[str, RunCurves]:
    return {"standard": curves(0, adapts=False), "adaptive": curves(1)}


def line_named(ax: Axes, start: str) -> np.ndarray:
    (line,) = [line for line in ax.lines if str(line.get_label()).startswith(start)]
    return np.asarray(line.get_ydata())


@pytest.mark.parametrize(
    ("draw", "field", "scale"),
    [
        (dynamic.shape_error_figure, "shape_error", 1e3),
        (dynamic.psi_figure, "psi", 1e2),
        (dynamic.mapping_error_figure, "mapping_error", 1e2),
    ],
)
def test_mean_line_and_band_limits(runs, draw, field: str, scale: float) -> None:
    (ax,) = draw(runs).axes
    for (name, c), patch in zip(runs.items(), ax.collections, strict=True):
        data = scale * getattr(c, field).numpy()
        assert line_named(ax, name) == pytest.approx(data.mean(1))
        corners = patch.get_paths()[0].vertices
        for t, low, high in zip(c.time.numpy(), data.min(1), data.max(1), strict=True):
            here = corners[np.isclose(corners[:, 0], t), 1]
            assert here.min() == pytest.approx(low) and here.max() == pytest.approx(high)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    means = [scale * float(getattr(c, field).mean()) for c in runs.values()]
    assert texts == [
        f"{name}, mean {mean:#.3g} {'mm' if scale == 1e3 else 'cm'}" for name, mean in zip(runs, means, strict=True)
    ]


def test_one_run_has_no_band(runs) -> None:
    (ax,) = dynamic.shape_error_figure({name: c.run(2) for name, c in runs.items()}).axes
    assert not ax.collections
    assert line_named(ax, "adaptive") == pytest.approx(1e3 * runs["adaptive"].shape_error[:, 2].numpy())


def test_controllers_keep_their_colours(runs) -> None:
    for figure in (dynamic.psi_figure(runs), dynamic.sensor_figure(runs), dynamic.parameter_figure(runs)):
        ax = figure.axes[0]
        for line in ax.lines:
            name = str(line.get_label()).split(",")[0]
            assert name.startswith("_") or line.get_color() == CONTROLLERS[name]


def test_diverged_runs_are_left_out_and_counted(runs) -> None:
    shape = runs["adaptive"].shape_error.clone()
    shape[7:, 1] = torch.nan
    runs["adaptive"] = runs["adaptive"]._replace(shape_error=shape)
    (ax,) = dynamic.shape_error_figure(runs).axes
    kept = 1e3 * shape[:, [0, 2, 3, 4]].numpy()
    assert line_named(ax, "adaptive") == pytest.approx(kept.mean(1))
    assert "(4 of 5 runs)" in ax.get_legend().get_texts()[1].get_text()
    with pytest.raises(ValueRangeError, match="at least one finite run"):
        dynamic.band(np.full((3, 2), np.nan))


def test_parameters_against_fixed_ones(runs) -> None:
    axes = dynamic.parameter_figure(runs).axes
    assert len(axes) == 3
    for i, ax in enumerate(axes):
        assert line_named(ax, "standard, fixed") == pytest.approx(runs["standard"].pi_hat[:, 0, i].numpy())
        assert line_named(ax, "adaptive") == pytest.approx(runs["adaptive"].pi_hat[..., i].mean(1).numpy())


def test_sensor_errors_two_rows_a_column_a_sensor(runs) -> None:
    axes = dynamic.sensor_figure(runs, names=["a", "b", "c"]).axes
    assert [ax.get_title(loc="left") for ax in axes] == ["a", "b", "c", "", "", ""]
    for s in range(3):
        for name, c in runs.items():
            assert line_named(axes[s], name) == pytest.approx(1e2 * c.angular[..., s].mean(1).numpy())
            assert line_named(axes[3 + s], name) == pytest.approx(1e2 * c.linear[..., s].mean(1).numpy())
    with pytest.raises(ShapeError, match="names must have 3 entries"):
        dynamic.sensor_figure(runs, names=["a"])


def test_settling_times() -> None:
    time = np.arange(5.0)
    e = np.array([[5, 5, 0, 5], [0, 5, 0, 5], [5, 0, 0, 5], [0, 0, 0, np.nan], [0, 0, 0, 0]], float)
    assert dynamic.settling_times(time, e, 1.0) == pytest.approx([3.0, 2.0, 0.0, 4.0])
    assert np.isinf(dynamic.settling_times(time, np.ones((5, 1)), 0.5)).all()


def test_settled_share_rises_to_all(runs) -> None:
    fast = torch.linspace(0.3, 0.0, 21, dtype=torch.float64)[:, None].expand(21, 5)
    runs = {name: c._replace(e=fast) for name, c in runs.items()}
    left, right = dynamic.end_effector_figure(runs, tolerance=0.05).axes
    assert line_named(left, "standard") == pytest.approx(1e3 * fast.mean(1).numpy())
    share = line_named(right, "adaptive")
    assert share[0] == 0.0 and share[-1] == 100.0 and (np.diff(share) >= 0).all()


def test_bad_runs_are_named(runs) -> None:
    with pytest.raises(ValueRangeError, match="at least one controller"):
        dynamic.psi_figure({})
    with pytest.raises(ShapeError, match=r"adaptive\.psi must have shape"):
        dynamic.psi_figure(runs | {"adaptive": runs["adaptive"]._replace(psi=torch.zeros(3, 5))})


def test_figures_are_drawn(tmp_path: Path, runs) -> None:
    for k, draw in enumerate((dynamic.parameter_figure, dynamic.sensor_figure, dynamic.end_effector_figure)):
        assert save_figure(draw(runs, title="some title"), tmp_path / f"{k}.png", dpi=40).stat().st_size > 1000
