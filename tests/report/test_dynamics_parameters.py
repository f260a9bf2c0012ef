"""A line for each payload, the truth dashed beside it, and arguments that do not fit refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.report.dynamics_parameters import dynamics_parameter_figure
from apcc_torch.report.style import save_figure

D = torch.float64
TIME = torch.linspace(0.0, 4.0, 9, dtype=D)
TRUE = torch.tensor([[0.08, 10.0, 200.0, m, 1.0] for m in (0.0, 0.5, 0.0, 0.5)], dtype=D)
FOUND = TRUE * (1.0 + 0.2 * torch.rand(9, 4, 5, generator=torch.Generator().manual_seed(0), dtype=D))


def test_lines_are_means_of_equal_payloads(tmp_path: Path) -> None:
    figure = dynamics_parameter_figure(TIME, FOUND, TRUE)
    payload, bending, *_ = figure.axes
    lines = {str(line.get_label()): np.asarray(line.get_ydata()) for line in bending.lines}
    np.testing.assert_allclose(lines["0.5 kg at the tip"], FOUND[:, [1, 3], 0].mean(1))
    np.testing.assert_allclose(lines["0 kg at the tip"], FOUND[:, [0, 2], 0].mean(1))
    np.testing.assert_allclose(lines["truth"], 0.08)
    levels = sorted(float(line.get_ydata()[0]) for line in payload.lines if line.get_linestyle() == "--")
    assert levels == [0.0, 0.5]
    assert save_figure(figure, tmp_path / "dynamics.png").stat().st_size > 0


def test_what_is_not_known_is_not_drawn() -> None:
    blind = TRUE.clone()
    blind[:, :2] = math.nan
    labels = [line.get_label() for line in dynamics_parameter_figure(TIME, FOUND, blind).axes[1].lines]
    assert "truth" not in labels
    assert len(dynamics_parameter_figure(TIME, FOUND).axes) == 4


def test_arguments_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match="theta_hat"):
        dynamics_parameter_figure(TIME[:5], FOUND)
    with pytest.raises(ShapeError, match="true"):
        dynamics_parameter_figure(TIME, FOUND, TRUE[:2])
    with pytest.raises(ValueRangeError, match="at least one run"):
        dynamics_parameter_figure(TIME, FOUND[:, :0])
