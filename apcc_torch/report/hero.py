"""The picture at the head of the README: a bending arm, a fixed model that misses it, an adapted one that fits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_base, draw_markers
from apcc_torch.report.space import Camera, Space, bounding_box
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor


def hero_figure(
    true_points: Tensor,
    models: Mapping[str, Tensor],
    markers: Tensor,
    time: Tensor,
    shape_errors: Mapping[str, Tensor],
    path: Tensor | None = None,
    camera: Camera | None = None,
) -> Figure:
    """An arm in several poses with its models on it, and the models' shape errors over time.

    Args:
        true_points: (S, N, 3) m, the true arm at S moments.
        models: Name -> (S, M, 3) m, what each model takes the arm for: {"fixed model": …, "adapted model": …}.
        markers: (S, k, 3) m, sensors on the true arm.
        time: (T,) s.
        shape_errors: Name -> (T,) m.
        path: (P, 3) m, desired path of the tip.
        camera: From where.

    Raises:
        ShapeError, DtypeError: An argument has the wrong shape.
    """
    S = len(check_tensor("true_points", true_points, (None, None, 3)))
    check_tensor("markers", markers, (S, None, 3))
    for name, points in models.items():
        check_tensor(name, points, (S, None, 3))
    for name, error in shape_errors.items():
        check_tensor(name, error, (len(time),))
    figure = style.new_figure(10.0, 5.0, constrained=False)
    colors = {name: (style.VERMILION, style.BLUE, *style.SERIES[2:])[k % 6] for k, name in enumerate(models)}
    arm = values(true_points)
    box = bounding_box(arm, *(values(p) for p in models.values()), margin=0.07)
    space = Space(figure.add_axes((0.0, 0.0, 0.61, 0.97)), box, camera, frame=False)
    if path is not None:
        space.plot(values(path), color=style.TARGET, linewidth=1.6, linestyle=":", zorder=0.6)
    _draw_tubes(space, arm)
    draw_base(space)
    for k, (name, points) in enumerate(models.items()):
        for shape in values(points):
            space.plot(shape, color="white", linewidth=3.4, zorder=3.0 + k, solid_capstyle="round")
            space.plot(shape, color=colors[name], linewidth=2.0, zorder=3.2 + k, solid_capstyle="round")
    draw_markers(space, values(markers), 6.5, zorder=6.0)
    _scale_bar(space)
    _draw_errors(figure, values(time), {name: values(error) for name, error in shape_errors.items()}, colors)
    keys = [Line2D([], [], color="#9aa5b1", linewidth=8, label="soft arm", solid_capstyle="round")]
    keys += [Line2D([], [], color=color, linewidth=2.4, label=name) for name, color in colors.items()]
    keys.append(Line2D([], [], marker="o", color=style.SENSOR, markersize=7, linestyle="none", label="sensors"))
    if path is not None:
        keys.append(Line2D([], [], color=style.TARGET, linewidth=1.6, linestyle=":", label="desired path"))
    style.figure_legend(figure, keys, loc="upper center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _draw_tubes(space: Space, arm: Array) -> None:
    """Each pose as a tube: nested strokes from a dark rim to a light core."""
    layers = 9
    for k, shape in enumerate(arm):
        strength = 0.45 + 0.55 * (k + 1) / len(arm)
        for layer in range(layers):
            part = layer / (layers - 1)
            grey = style.faded("#7b8794", strength * (1.0 - 0.75 * part))
            width = 17.0 * (1.0 - 0.8 * part)
            space.plot(shape, color=grey, linewidth=width, zorder=2.0 + 0.5 * k / len(arm), solid_capstyle="butt")


def _scale_bar(space: Space) -> None:
    """10 cm, at the lower left; true for lengths in the plane of the picture."""
    x, y = space.ax.get_xlim()[0], space.ax.get_ylim()[0]
    left, low = x + 0.03, y + 0.03
    space.ax.plot([left, left + 0.1], [low, low], color=style.INK, linewidth=2.5, solid_capstyle="butt")
    space.ax.text(left + 0.05, low + 0.012, "10 cm", ha="center", fontsize=style.TICK, color=style.INK)


def _draw_errors(figure: Figure, time: Array, errors: Mapping[str, Array], colors: Mapping[str, str]) -> None:
    ax = figure.add_axes((0.68, 0.14, 0.3, 0.66))
    for k, (name, error) in enumerate(errors.items()):
        color = colors.get(name, style.SERIES[k % len(style.SERIES)])
        ax.plot(time, 1e3 * error, color=color, linewidth=2.2, label=name)
    style.dress(ax, "time (s)", "shape error (mm)", "the model learns the arm")
    style.log_scale(ax, [1e3 * np.asarray(error) for error in errors.values()], decades=3.0)
    style.fit_time(ax, time)
