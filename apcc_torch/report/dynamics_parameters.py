"""Figure of the parameters that a law of the dynamics estimates, over time, beside the truth where it is known."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.report import style
from apcc_torch.report.dynamic import TIME, draw_band
from apcc_torch.report.style import values
from apcc_torch.shapes import check_tensor

PANELS = (
    ("payload", "payload (kg)"),
    ("bending_rigidity", r"bending rigidity $EI$ (N m$^2$)"),
    ("tendon_damping", "tendon friction (N s/m)"),
    ("axial_rigidity", r"axial rigidity $EA$ (N)"),
)


def dynamics_parameter_figure(time: Tensor, theta_hat: Tensor, true: Tensor | None = None, title: str = "") -> Figure:
    """theta_hat of R runs over time, a line for each true payload: the mean over its runs, and their range.

    Args:
        time: (T,) s.
        theta_hat: (T, R, 5), as `dynamics_regressor.PARAMETERS`.
        true: (R, 5) the arm's own parameters, drawn dashed, not a number where there is none; None where not known.
        title: Text over the first panel.

    Raises:
        ShapeError, DtypeError: The arguments do not fit each other.
        ValueRangeError: theta_hat holds no run.
    """
    T, R = len(check_tensor("time", time, (None,))), theta_hat.shape[-2]
    check_tensor("theta_hat", theta_hat, (T, R, len(PARAMETERS)))
    if R == 0:
        raise ValueRangeError("theta_hat must hold at least one run, got none")
    estimates, clock = values(theta_hat), values(time)
    truth = None if true is None else values(check_tensor("true", true, (R, len(PARAMETERS))))
    payloads = np.zeros(R) if truth is None else truth[:, PARAMETERS.index("payload")]
    figure = style.new_figure(10.0, 6.4)
    panels = figure.subplots(2, 2, sharex=True)
    for ax, (name, label) in zip(panels.flat, PANELS, strict=True):
        column = PARAMETERS.index(name)
        for index, payload in enumerate(np.unique(payloads)):
            rows = payloads == payload
            color = style.SERIES[index % len(style.SERIES)]
            draw_band(ax, clock, estimates[:, rows, column], color, f"{payload:g} kg at the tip")
            if truth is not None and name == "payload":
                ax.axhline(payload, color=color, linewidth=1.2, linestyle=(0, (4, 3)))
        if truth is not None and name != "payload" and np.isfinite(truth[0, column]):
            ax.axhline(truth[0, column], color=style.INK, linewidth=1.2, linestyle=(0, (4, 3)), label="truth")
        style.dress(ax, TIME if ax in panels[1] else "", label, title if ax is panels[0, 0] else "")
        ax.margins(y=0.12)
        style.fit_time(ax, clock)
    style.figure_legend(figure, panels[0, 1], loc="outside upper right")
    return figure
