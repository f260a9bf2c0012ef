"""An environment's arm in the browser: what `render_mode="human"` shows."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.plain_text import plain_logger
from apcc_torch.report.style import values
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import POINTS
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.panel import Panel
from apcc_torch.viewing.scene import Scene
from apcc_torch.web_address import WebAddress

log = plain_logger(__name__)

FRAME = 0.03
"""s that a picture is shown at least; those that come sooner are not."""
SLENDER = 50.0
"""Length of an arm over the radius of the tube that it is drawn with."""


class Arm(Protocol):
    """What is shown, world frame, m: `envs.rendering.Picture` is one.

    backbone: (P, 3), evenly in material length. ends: (n,) where its sections end, over its length.
    """

    backbone: Tensor
    ends: Tensor
    tendons: Tensor
    sensors: Tensor
    goal: Tensor
    text: str


class EnvWindow:
    """Shows one arm after the other on a page, no faster than real time.

    The page is served on the loopback, at the default port where that is free, else at another one; the log says where.

    Args:
        length: Of the arm, m.
        upward: Whether it stands; else it hangs.

    Attributes:
        page: Once something is shown.
    """

    def __init__(self, length: float = 0.6, upward: bool = False) -> None:
        self.length, self.upward = length, upward
        self.page: Page | None = None
        self.due = self.shown = 0.0

    def show(self, arm: Arm, period: float) -> None:
        """Shows it, as soon as `period` s have passed since the last one.

        Raises:
            ConfigError: viser is not installed.
        """
        time.sleep(max(self.due - time.monotonic(), 0.0))
        now = time.monotonic()
        self.due = now + period
        if now < self.shown + FRAME:
            return
        self.shown = now
        moment = Moment(
            _sections(values(arm.backbone), values(arm.ends)),
            values(arm.tendons),
            sensors=values(arm.sensors),
            target=values(arm.goal),
        )
        if self.page is None:
            self.page = self._opened(len(moment.sections))
        self.scene.show(moment)
        self.panel.tell(_told(arm.text))

    def _opened(self, sections: int) -> Page:
        try:
            address = WebAddress().free()
        except ConfigError:
            address = WebAddress(port=0)
        page = Page(address, "environment", self.length, self.upward)
        self.scene = Scene(page, self.length, self.length / SLENDER, self.upward)
        self.panel = Panel(page, self.scene, sections)
        self.panel.tell({"": ""})
        self.panel.add_layers(("arm", "tendons", "sensors"))
        log.warning("%s shows the environment", page.address.url)
        return page

    def close(self) -> None:
        """Ends the page, if there is one."""
        if self.page is not None:
            self.page.close()
            self.page = None


def _told(text: str) -> dict[str, str]:
    """Numbers by their names of "t = 0.10 s, error 20 mm"."""
    pairs = (part.replace(" = ", " ").partition(" ") for part in text.split(", "))
    return {name: value for name, _, value in pairs}


def _sections(backbone: Array, ends: Array) -> Array:
    """(S, P, 3) of a centre line (M, 3) whose sections end at shares (S,) of it."""
    share = np.linspace(0.0, 1.0, len(backbone))
    at = np.linspace((0.0, *ends[:-1]), ends, POINTS, axis=-1)
    return np.stack([np.interp(at, share, backbone[:, axis]) for axis in range(3)], axis=-1)
