"""The page of a run on an arm, in a process of its own: it shows what the run copies into memory that both share."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.viewing.live_process import Watched
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.panel import MODELLED_ARM, TOLD, Panel, numbers_of
from apcc_torch.viewing.recent_errors import RecentErrors
from apcc_torch.viewing.scene import Scene
from apcc_torch.web_address import WebAddress

LAYERS = ("arm", "tendons", "sensors")


def live_page(address: WebAddress, watched: Watched) -> LivePage:
    """The page of a run, served at an address.

    Raises:
        ConfigError: viser is not installed, or the port is taken.
    """
    return LivePage(Page(address, watched.name, watched.size.length, watched.size.upward), watched)


class LivePage:
    """The page of a run.

    Args:
        page: Empty.
        watched: The arm.
    """

    def __init__(self, page: Page, watched: Watched) -> None:
        self.watched = watched
        self.scene = Scene(page, *watched.size)
        self.panel = Panel(page, self.scene, watched.outline.sections)
        self.panel.tell({"state": "connecting"})
        self.errors = RecentErrors()
        self.panel.draw_error(*self.errors.curve())
        self.panel.add_layers(LAYERS, MODELLED_ARM)
        self.told = -TOLD
        self.last, self.untold = b"", False

    def show(self, sample: NDArray[np.void]) -> None:
        """Shows a sample, if it is another one than the last."""
        now, seen = time.monotonic(), sample.tobytes()
        due = now >= self.told + TOLD
        if seen == self.last and not (due and self.untold):
            return
        if seen != self.last and sample["count"]:
            self.scene.show(self._moment(sample))
        self.last, self.untold = seen, not due
        if not due:
            return
        self.told = now
        state, message = (sample[name].item().decode() for name in ("state", "message"))
        numbers = {"state": state or "connecting", "last event": message[:60]}
        if sample["count"]:
            error = 1e3 * float(np.linalg.norm(sample["e"]))
            self.errors.keep(float(sample["time"]), error)
            numbers |= self._numbers(sample, error)
            self.panel.draw_error(*self.errors.curve())
        self.panel.tell(numbers)

    def _numbers(self, sample: NDArray[np.void], error: float) -> dict[str, str]:
        return {
            "time": f"{float(sample['time']):.1f} s",
            "error of the tip": f"{error:.1f} mm",
            **numbers_of(sample["x_d"], sample["pi_hat"], float(sample["effort"].max())),
            "missed deadlines": f"{int(sample['overruns'])}",
        }

    def _moment(self, sample: Any) -> Moment:
        q, pi_hat = torch.from_numpy(sample["q_bar"]), torch.from_numpy(sample["pi_hat"])
        sections, tendons = self.watched.outline(q, pi_hat)
        poses: Array = sample["T"]
        return Moment(sections, tendons, sample["effort"], poses, target=sample["x_d"])
