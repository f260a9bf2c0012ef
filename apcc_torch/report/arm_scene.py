"""An environment's arm as a picture: backbone, tendons, sensors and goal."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_base, draw_markers, draw_target
from apcc_torch.report.space import Box, Space
from apcc_torch.report.style import values

INCHES, PIXELS_PER_INCH = (5.0, 5.0), 100


class Arm(Protocol):
    """What is drawn, world frame, m: `envs.rendering.Picture` is one."""

    backbone: Tensor
    tendons: Tensor
    sensors: Tensor
    goal: Tensor
    text: str


class ArmScene:
    """Draws one arm after the other on the same axes.

    Args:
        length: Of the arm, m: all that it reaches is shown.
        upward: Whether it stands; else it hangs.
    """

    def __init__(self, length: float = 0.6, upward: bool = False) -> None:
        down, up = (-1.0 / 30.0, 4.0 / 3.0) if upward else (-4.0 / 3.0, 1.0 / 30.0)
        box = Box(length * np.array((-0.75, -0.75, down)), length * np.array((0.75, 0.75, up)))
        with style.own_look():
            self.figure = style.new_figure(*INCHES, constrained=False)
            self.figure.set_dpi(PIXELS_PER_INCH)
            self.canvas = FigureCanvasAgg(self.figure)
            self.space = Space(self.figure.add_axes((0.0, 0.0, 0.96, 0.94)), box)
            draw_base(self.space)
            self.title = self.figure.text(0.03, 0.955, "", fontsize=11, color=style.INK)
        self.moving: list[Any] = []

    def frame(self, arm: Arm) -> NDArray[Any]:
        """The picture, (H, W, 3) uint8."""
        with style.own_look():
            return self._frame(arm)

    def _frame(self, arm: Arm) -> NDArray[Any]:
        for line in self.moving:
            line.remove()
        look = {"color": style.EDGE, "linewidth": 0.9, "zorder": 1.8}
        self.moving = [self.space.plot(values(tendon), **look) for tendon in arm.tendons]
        goal = values(arm.goal)
        if goal.ndim == 1:
            self.moving.append(draw_target(self.space, goal))
        else:
            whole = np.concatenate([np.zeros((1, 3)), goal])
            look = {"color": style.TARGET, "linewidth": 1.6, "linestyle": ":", "zorder": 3.0}
            self.moving.append(self.space.plot(whole, marker="o", markersize=5.0, **look))
        round_ends = {"solid_capstyle": "round"}
        self.moving.append(
            self.space.plot(values(arm.backbone), color=style.TRUE, linewidth=5.0, zorder=2.5, **round_ends)
        )
        self.moving.append(draw_markers(self.space, values(arm.sensors)))
        self.title.set_text(arm.text)
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
