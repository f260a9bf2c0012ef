"""Figures of the experiments on an arm: what is drawn is what was given, scaled, to each run's own end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.overlay import Overlay, error_figure, overlay_figure
from apcc_torch.report.state_feedback import Estimate, Estimates, final_figure, four_panel_figure, norm_figure
from apcc_torch.report.style import save_figure


def estimates(seed: int, end: float = 2.0) -> Estimates:
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    time = torch.linspace(0.0, end, 11, dtype=torch.float64)
    keys = [(case, mode) for case in ("non-decoupled", "decoupled") for mode in ("pose", "position")]
    return {key: Estimate(time, draw(11, 20, 3), draw(11, 3, 3), draw(11, 3), draw(11, 3)) for key in keys}


def curves(seconds: float) -> RunCurves:
    time = torch.linspace(0.0, seconds, 31, dtype=torch.float64)
    e = (0.1 * torch.exp(-time)).unsqueeze(-1)
    three = e.unsqueeze(-1).expand(31, 1, 3)
    return RunCurves(time, e, e, three, three, e, three, e, torch.zeros_like(e).long())


def test_norms_are_means_over_the_runs_as_long_as_they_last() -> None:
    short, long = estimates(0, 1.0), estimates(1, 2.0)
    figure = norm_figure([short, long])
    linear, angular = figure.axes
    assert len(linear.lines) == len(angular.lines) == 6  # a sensor and a case each
    drawn = np.asarray(linear.lines[0].get_ydata())
    a, b = short["non-decoupled", "pose"].linear[:, 0].numpy(), long["non-decoupled", "pose"].linear[:, 0].numpy()
    assert drawn[0] == pytest.approx(1e2 * (a[0] + b[0]) / 2)
    assert drawn[-1] == pytest.approx(1e2 * b[-1])
    angles = np.asarray(angular.lines[4].get_ydata())
    first = [run["decoupled", "pose"].angular[0, 1].item() for run in (short, long)]
    assert angles[0] == pytest.approx(1e2 * np.mean(first))


def test_four_panels_hold_the_four_estimators(tmp_path: Path) -> None:
    figure = four_panel_figure(estimates(2), 4, "run 4")
    assert [ax.get_title() for ax in figure.axes] == [
        "non-decoupled, pose", "non-decoupled, position", "decoupled, pose", "decoupled, position",
    ]  # fmt: skip
    assert save_figure(figure, tmp_path / "a.png").stat().st_size > 10_000


def test_final_shapes_have_a_panel_each(tmp_path: Path) -> None:
    shape = torch.rand(20, 3, dtype=torch.float64), torch.rand(3, 3, dtype=torch.float64)
    figure = final_figure({"run_4": shape, "run_8": shape})
    assert [ax.get_title() for ax in figure.axes] == ["run 4", "run 8"]
    assert save_figure(figure, tmp_path / "a.png").stat().st_size > 5_000


def test_an_overlay_shows_y_and_z(tmp_path: Path) -> None:
    moment = Overlay(*(torch.rand(n, 3, dtype=torch.float64) for n in (20, 3, 30)), torch.tensor([0.0, 0.15, -0.5]))
    figure = overlay_figure({"standard": moment, "adaptive": moment})
    true, model, sensors, target = figure.axes[0].lines
    assert np.allclose(np.column_stack(model.get_data()), moment.model[:, 1:])
    assert np.allclose(np.column_stack(sensors.get_data()), moment.sensors[:, 1:])
    assert np.allclose(np.column_stack(true.get_data())[0], 0.0)
    assert np.allclose(np.column_stack(target.get_data()), [[0.15, -0.5]])
    assert save_figure(figure, tmp_path / "a.png").stat().st_size > 5_000


def test_errors_end_where_their_runs_end() -> None:
    ax = error_figure({"standard": curves(6.01), "adaptive": curves(2.76)}, 1e-3).axes[0]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["standard, 6.01 s", "adaptive, 2.76 s"]
    ends = [line.get_xdata()[0] for line in ax.lines if len(line.get_xdata()) == 2 and line.get_xdata()[0] > 1.5]
    assert ends == pytest.approx([6.01, 2.76])
    assert np.allclose(ax.lines[0].get_ydata(), 100.0 * np.exp(-curves(6.01).time.numpy()))
