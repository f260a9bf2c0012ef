"""The figures of section V-A hold the log's numbers, in the units that their axes name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.report import kinematic
from apcc_torch.report.space import Camera
from apcc_torch.report.style import save_figures
from apcc_torch.simulation.kinematic import KinematicLog


def axes_with(figure: Figure, text: str) -> Axes:
    (found,) = [ax for ax in figure.axes if text in ax.get_ylabel()]
    return found


@pytest.fixture
def panel(log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone) -> Figure:
    return kinematic.convergence_figure(log, pi, abscissae, arm, end=3.0, count=4)


def test_curves_hold_the_log(panel: Figure, log: KinematicLog, pi: Tensor, arm: PCCBackbone) -> None:
    error = axes_with(panel, "x_d - x").lines[0].get_xydata()
    assert error[:, 0] == pytest.approx(log.time.numpy())
    assert error[:, 1] == pytest.approx(1e3 * np.linalg.norm((log.x_d - log.x).numpy(), axis=1))
    true, model = axes_with(panel, "total length").lines[:2]
    assert true.get_ydata() == pytest.approx((pi + log.q_true.reshape(-1, 3, 3)[..., 2]).sum(-1).numpy())
    assert model.get_ydata() == pytest.approx((log.pi_hat + log.q_bar.reshape(-1, 3, 3)[..., 2]).sum(-1).numpy())
    # Eq. (52) anew, from the points.
    p = (arm.points(log.q_true, pi, 500) - arm.points(log.q_bar, log.pi_hat, 500)).numpy()
    shape = axes_with(panel, "shape").lines[0].get_ydata()
    assert shape == pytest.approx(1e3 * np.sqrt((p**2).sum(-1)).mean(-1))


def test_shapes_and_sensors_are_those_of_the_moments(
    panel: Figure, log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone
) -> None:
    shots = kinematic.snapshots(log, pi, abscissae, arm, 3.0, 4)
    assert shots.time.tolist() == pytest.approx([0.0, 1.0, 2.0, 3.0])
    tips = Camera().project(shots.true_points[:, -1].numpy())
    left, middle, right = panel.axes[:3]
    lengths = [len(line.get_xdata()) for line in left.lines]
    drawn = [line.get_xydata()[-1] for line, n in zip(left.lines, lengths, strict=True) if n == 90]
    assert np.array(drawn) == pytest.approx(tips)
    dots = [line for line in middle.lines if line.get_marker() == "o"]
    assert dots[0].get_xydata() == pytest.approx(Camera().project(shots.model_markers.numpy()).reshape(-1, 2))
    assert sum(len(line.get_xdata()) == 90 for line in right.lines) == 8


def test_sensors_lie_where_algorithm_1_puts_them(
    log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone
) -> None:
    shots = kinematic.snapshots(log, pi, abscissae, arm, 4.0, 3)
    # On the true arm the sensors are at its section tips, the last one at its end.
    assert shots.true_markers[:, -1].numpy() == pytest.approx(shots.true_points[:, -1].numpy())
    # The longer model holds the last sensor before its tip, until it has adapted.
    gap = (shots.model_markers[:, -1] - shots.model_points[:, -1]).norm(dim=-1)
    assert gap[0] > 0.05 and gap[-1] == pytest.approx(0.0, abs=1e-9)


def test_estimates_against_the_true_lengths(log: KinematicLog, pi: Tensor) -> None:
    (ax,) = kinematic.parameter_figure(log, pi).axes
    for i in range(3):
        solid, dashed = ax.lines[2 * i : 2 * i + 2]
        assert solid.get_ydata() == pytest.approx(log.pi_hat[:, i].numpy())
        assert set(dashed.get_ydata()) == {float(pi[i])} and dashed.get_color() == solid.get_color()


def test_sensor_errors_per_sensor(log: KinematicLog, abscissae: Tensor) -> None:
    upper, lower = kinematic.sensor_figure(log, abscissae).axes
    for k in range(3):
        assert upper.lines[k].get_ydata() == pytest.approx(1e2 * log.angular_error[:, k].numpy())
        assert lower.lines[k].get_ydata() == pytest.approx(1e3 * log.linear_error[:, k].numpy())
    assert "crad" in upper.get_ylabel() and "mm" in lower.get_ylabel()


def test_every_figure_is_written(
    tmp_path: Path, log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone
) -> None:
    rows = KinematicLog(log.time, *(torch.stack((field, field), dim=1) for field in log[1:]))
    draw = kinematic.kinematic_figures(rows, pi, abscissae, arm)
    figures = {name: make() for name, make in draw.items()}
    labelled = [ax for figure in figures.values() for ax in figure.axes if ax.get_ylabel()]
    assert len(labelled) == 6 and all(ax.get_ylabel().endswith(")") for ax in labelled)  # a unit on each
    assert all(figure.axes[-1].get_xlabel() == "time (s)" for figure in figures.values())
    paths = save_figures(draw, tmp_path, dpi=40)
    assert [p.name for p in paths] == ["figure_7.png", "figure_8.png", "figure_9.png"]


def test_other_starts_are_drawn_behind(log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone) -> None:
    rows = KinematicLog(log.time, *(torch.stack((field, field, field), dim=1) for field in log[1:]))
    alone = KinematicLog(log.time, *(field.unsqueeze(1) for field in log[1:]))
    for name in ("figure_7.png", "figure_8.png", "figure_9.png"):
        many, one = (kinematic.kinematic_figures(each, pi, abscissae, arm)[name]() for each in (rows, alone))
        lines = [sum(len(ax.lines) for ax in figure.axes) for figure in (many, one)]
        # Two more rows: three panels, three sections, or three sensors in two panels.
        assert lines[0] - lines[1] == {"figure_7.png": 6, "figure_8.png": 6, "figure_9.png": 12}[name]


def test_a_row_of_a_batch(log: KinematicLog, pi: Tensor, abscissae: Tensor, arm: PCCBackbone) -> None:
    batch = KinematicLog(log.time, *(torch.stack((0 * field, field), dim=1) for field in log[1:]))
    row = kinematic.select_row(batch, 1)
    assert all(torch.equal(a, b) for a, b in zip(row, log, strict=True))
    with pytest.raises(ShapeError, match=r"log\.x_d must have shape"):
        kinematic.convergence_figure(batch, pi, abscissae, arm)
