"""The process that shows a run live: it looks at the last turn in memory that it shares with the run."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Lock
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.errors import ApccError
from apcc_torch.hardware.stop_request import SIGNALS
from apcc_torch.processes import end_with
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.outline import Outline
from apcc_torch.web_address import WebAddress

FRAME = 0.05
"""s between two pictures, and between two copies."""


class Watched(NamedTuple):
    """What is known of the arm that is shown.

    name: Of the run. size: How large it is drawn. outline: Of the controller's model. sensors: How many.
    """

    name: str
    size: DrawnSize
    outline: Outline
    sensors: int

    def sample_type(self) -> np.dtype[np.void]:
        """The layout of the shared memory: the last turn, in numbers.

        `began` is when the run's time was zero, ns since 1970, `stamp` the last measurement's time that the controller
        stepped on, s.
        """
        backbone, routing = self.outline.backbone, self.outline.routing
        assert routing is not None  # a controller on an arm has tendons
        turn = [("over", "i8"), ("count", "i8"), ("time", "f8"), ("overruns", "i8"), ("began", "i8"), ("stamp", "f8")]
        told = [("state", "S16"), ("message", "S160")]
        model = [("q_bar", "f8", backbone.n), ("pi_hat", "f8", backbone.n_sections), ("x_d", "f8", 3), ("e", "f8", 3)]
        measured = [("T", "f8", (self.sensors, 4, 4)), ("effort", "f8", routing.n_tendons)]
        return np.dtype([*turn, *told, *model, *measured])


def sample_in(memory: ctypes.Array[ctypes.c_byte], watched: Watched) -> NDArray[np.void]:
    """The last turn, as the shared memory holds it; what is written into it is written there."""
    sample: NDArray[np.void] = np.ctypeslib.as_array(memory).view(watched.sample_type()).reshape(())
    return sample


class Shown(Protocol):
    """What shows a run, in the process."""

    def show(self, sample: NDArray[np.void]) -> None:
        """Shows a sample, which may be the last one again."""


class Showing(NamedTuple):
    """A way to show a run.

    library: That it needs. missing: What to say where that is not installed. make: What shows it, from address and arm.
    """

    library: str
    missing: str
    make: Callable[[WebAddress, Watched], Shown]


def serve(
    make: Callable[[WebAddress, Watched], Shown],
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
    with torch.inference_mode():
        try:
            shown = make(address, watched)
        except ApccError as error:
            ready.send(str(error))
            return
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
