"""The page of a run on an arm, in a process of its own: it shows what the run copies into memory that both share."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.errors import ApccError
from apcc_torch.hardware.stop_request import SIGNALS
from apcc_torch.processes import end_with
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import Outline
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.panel import MODELLED_ARM, TOLD, Panel, numbers_of
from apcc_torch.viewing.recent_errors import RecentErrors
from apcc_torch.viewing.scene import Scene
from apcc_torch.web_address import WebAddress

FRAME = 0.05
"""s between two pictures, and between two copies."""
LAYERS = ("arm", "tendons", "sensors")


class Watched(NamedTuple):
    """What the page needs to know of the arm.

    name: Above the page. size: How large it is drawn. outline: Of the controller's model. sensors: How many.
    """

    name: str
    size: DrawnSize
    outline: Outline
    sensors: int

    def sample_type(self) -> np.dtype[np.void]:
        """The layout of the shared memory: the last turn, in numbers."""
        backbone, routing = self.outline.backbone, self.outline.routing
        assert routing is not None  # a controller on an arm has tendons
        turn = [("over", "i8"), ("count", "i8"), ("time", "f8"), ("overruns", "i8")]
        told = [("state", "S16"), ("message", "S160")]
        model = [("q_bar", "f8", backbone.n), ("pi_hat", "f8", backbone.n_sections), ("x_d", "f8", 3), ("e", "f8", 3)]
        measured = [("T", "f8", (self.sensors, 4, 4)), ("effort", "f8", routing.n_tendons)]
        return np.dtype([*turn, *told, *model, *measured])


def sample_in(memory: ctypes.Array[ctypes.c_byte], watched: Watched) -> NDArray[np.void]:
    """The last turn, as the shared memory holds it; what is written into it is written there."""
    sample: NDArray[np.void] = np.ctypeslib.as_array(memory).view(watched.sample_type()).reshape(())
    return sample


def serve(
    watched: Watched,
    address: WebAddress,
    memory: ctypes.Array[ctypes.c_byte],
    lock: Lock,
    ready: Connection,
    parent: int,
) -> None:
    """The process: shows the memory until it is over, or the process that asked for it has ended."""
    end_with(parent)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # they reach the whole group; the run says when it is over
    torch.set_num_threads(1)
    try:
        page = Page(address, watched.name, watched.size.length, watched.size.upward)
    except ApccError as error:
        ready.send(str(error))
        return
    with torch.inference_mode():
        shown = LivePage(page, watched)
        ready.send("")
        sample = sample_in(memory, watched)
        ended = False
        while not ended:
            time.sleep(FRAME)
            with lock:
                now = sample.copy()
            ended = bool(now["over"])
            shown.show(now)
    time.sleep(FRAME)  # until it has been sent
    os._exit(0)  # at once: to take leave of every browser may take seconds


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
