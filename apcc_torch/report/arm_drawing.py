"""An arm's file as a drawing to check by eye: sections, sensors and tendons at rest, and the tendons around it."""

from __future__ import annotations

from math import cos, pi
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apcc_torch.model.arm import Arm
from apcc_torch.report import style

MM = 1e3


def arm_figure(arm: Arm) -> Figure:
    """The arm at rest from the side, to scale, and its tendons around the backbone, seen along the arm from its base.

    Args:
        arm: A single one, no batch.
    """
    figure = style.new_figure(10.0, 7.0)
    side, around = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_side(side, arm)
    _draw_around(around, arm)
    return figure


def _draw_side(ax: Axes, arm: Arm) -> None:
    lengths = MM * style.values(arm.rest_lengths())
    routing, up = arm.routing(), -1.0 if arm.base == "hanging" else 1.0
    total, ends = lengths.sum(), lengths.cumsum()
    offset = MM * float(routing.offsets.max())
    half = max(0.5 * total, 3.0 * offset)
    style.dress(ax, "x at the base (mm)", "along the arm (mm)", f"{arm.name}: {total:.4g} mm, {_mass(arm)}")
    for angle, at, begin, end in zip(
        *(style.values(t) for t in (routing.angles, routing.offsets, routing.starts, routing.anchors)), strict=True
    ):
        x = MM * at * cos(angle)
        ax.plot((x, x), (up * MM * begin, up * MM * end), color=style.EDGE, linewidth=1.0, zorder=1.8)
    for i, (length, end) in enumerate(zip(lengths, ends, strict=True)):
        color = style.SERIES[i % len(style.SERIES)]
        ax.plot((0.0, 0.0), (up * (end - length), up * end), color=color, linewidth=5.0, solid_capstyle="butt")
        ax.plot((-1.3 * offset, 1.3 * offset), (up * end,) * 2, color=style.INK, linewidth=1.2)
        ax.annotate(
            f"section {i + 1}\n{length:.4g} mm",
            (-1.5 * offset, up * (end - 0.5 * length)),
            xytext=(-10, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=style.TICK,
            color=color,
        )
    for k, place in enumerate(MM * style.values(arm.sensor_places())):
        ax.plot(0.0, up * place, "o", color=style.SENSOR, markersize=8.0, zorder=5.0)
        ax.annotate(
            f"sensor {k + 1} at {place:.4g} mm",
            (1.5 * offset, up * place),
            xytext=(10, 0),
            textcoords="offset points",
            va="center",
            fontsize=style.TICK,
            color=style.SENSOR,
        )
    ax.plot((-2.0 * offset, 2.0 * offset), (0.0, 0.0), color=style.TRUE, linewidth=6.0, solid_capstyle="butt")
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(-half, half)
    ax.set_ylim(*sorted((-up * 0.06 * total, up * 1.08 * total)))


def _draw_around(ax: Axes, arm: Arm) -> None:
    routing = arm.routing()
    anchors = style.values(routing.anchors)
    racks = np.unique(anchors)
    offset = MM * float(routing.offsets.max())
    what = "tendons" if arm.chambers is None else "chambers"
    title = f"{routing.n_tendons} {what}" + (f", {routing.layout}" if arm.chambers is None else "")
    style.dress(ax, "x (mm)", "y (mm)", title)
    ring = np.linspace(0.0, 2.0 * pi, 200)
    ax.plot(offset * np.cos(ring), offset * np.sin(ring), color=style.GRID, linewidth=1.2, zorder=1.0)
    ax.plot(0.0, 0.0, "o", color=style.TRUE, markersize=9.0)
    angles, offsets = style.values(routing.angles), MM * style.values(routing.offsets)
    places = np.stack((offsets * np.cos(angles), offsets * np.sin(angles)), axis=-1)
    for k, rack in enumerate(racks):
        look: dict[str, Any] = {"color": style.SERIES[k % len(style.SERIES)], "markersize": 9.0}
        ax.plot(*places[anchors == rack].T, "o", label=f"end at {MM * rack:.4g} mm", **look)
    here: dict[tuple[float, float], list[str]] = {}
    for i, (x, y) in enumerate(places):  # tendons of far racks may run through one hole
        here.setdefault((round(float(x), 1), round(float(y), 1)), []).append(f"{i + 1}")
    for (x, y), numbers in here.items():
        # Away from the middle, so that several numbers do not lie on their mark.
        side = "center" if abs(x) < 0.3 * offset else "left" if x > 0.0 else "right"
        look = {"ha": side, "va": "center", "fontsize": style.TICK, "color": style.INK}
        out = 1.18 if side == "center" else 1.1
        ax.annotate(", ".join(numbers), (out * x, out * y), **look)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(-1.4 * offset, 1.4 * offset)
    ax.set_ylim(-1.4 * offset, 1.4 * offset)
    style.legend(ax, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, title=f"{what} by number")


def _mass(arm: Arm) -> str:
    mass = float(arm.section_masses().sum())
    return f"{mass:.3g} kg" if mass >= 0.1 else f"{1e3 * mass:.3g} g"
