"""Figures of an identification draw what they are given."""

from __future__ import annotations

import numpy as np
import torch

from apcc_torch.identification.intervals import Interval
from apcc_torch.report.identification import Outcome, identification_figures


def _outcome() -> Outcome:
    generator = torch.Generator().manual_seed(0)
    measured = 0.1 * torch.randn(60, 2, 3, generator=generator, dtype=torch.float64)
    off = torch.tensor([3e-3, 4e-3, 0.0], dtype=torch.float64)
    predicted = {"linear": measured + 4.0 * off, "pcc_online": measured + 2.0 * off, "arm_identified": measured + off}
    predicted["pcc_online"] = predicted["pcc_online"].index_fill(0, torch.arange(0, 60, 2), torch.nan)
    q = torch.randn(60, 6, generator=generator, dtype=torch.float64)
    parameters = [Interval("offset: tendon 1", "m", 0.005, 0.006, 0.0055, 0.0065, 0.9)]
    return Outcome(measured, predicted, torch.cat((torch.arange(10, 20), torch.arange(40, 50))), q, parameters)


def test_bars_are_the_errors() -> None:
    ax = identification_figures(_outcome(), 200.0, "arm")["models.png"]().axes[0]
    np.testing.assert_allclose([patch.get_width() for patch in ax.patches], [20.0, 10.0, 5.0])
    assert "5.00 mm, 2.50 %" in ax.texts[-1].get_text()


def test_lines_break_where_samples_jump() -> None:
    figure = identification_figures(_outcome(), 200.0, "arm")["prediction.png"]()
    assert len(figure.axes) == 3
    drawn = np.asarray(figure.axes[0].lines[0].get_ydata(), dtype=float)
    assert len(drawn) == 21 and np.isnan(drawn).sum() == 1


def test_residuals_and_parameters() -> None:
    figures = identification_figures(_outcome(), 200.0, "arm")
    bend = figures["residual.png"]().axes[2]
    np.testing.assert_allclose(np.asarray(bend.lines[0].get_ydata(), dtype=float), 5.0)
    interval = figures["parameters.png"]().axes[0].lines[0]
    np.testing.assert_allclose(np.asarray(interval.get_xdata(), dtype=float), [1.0, 3.0])
