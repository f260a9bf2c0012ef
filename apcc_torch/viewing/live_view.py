"""A run on an arm in the browser, live: drawn by a process of its own, so that the loop's timing does not feel it.

The loop hands over nothing but a reference. Some twenty times a second a thread copies the last turn into memory that
the two processes share; turns in between are not shown.
"""

from __future__ import annotations

import ctypes
import importlib.util
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from multiprocessing.synchronize import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.hardware.control import Start
from apcc_torch.hardware.records import Event, Tick
from apcc_torch.hardware.stop_request import SIGNALS
from apcc_torch.plain_text import for_terminal, plain_logger
from apcc_torch.processes import deaf_children, end_with
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import Outline
from apcc_torch.viewing.page import EXTRA, Page
from apcc_torch.viewing.panel import MODELLED_ARM, Panel
from apcc_torch.viewing.scene import Scene
from apcc_torch.web_address import WebAddress

log = plain_logger(__name__)

FRAME = 0.05
"""s between two pictures, and between two copies."""
TOLD = 0.2
"""s between two readings of the numbers and the plot."""
KEPT = 20.0
"""s of the error that the plot shows."""
START_TIMEOUT = 120.0
"""Longest that the process may take to begin, s: it imports torch."""
WAIT = 5.0
"""Longest wait for its end, s."""
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
        return np.dtype(
            [
                *(
                    ("over", "i8"),
                    ("count", "i8"),
                    ("time", "f8"),
                    ("overruns", "i8"),
                    ("state", "S16"),
                    ("message", "S160"),
                ),
                *(("q_bar", "f8", backbone.n), ("pi_hat", "f8", backbone.n_sections), ("x_d", "f8", 3)),
                *(("e", "f8", 3), ("T", "f8", (self.sensors, 4, 4)), ("effort", "f8", routing.n_tendons)),
            ]
        )


class LiveView:
    """Observes a run, and shows it on a page as long as `with` lasts.

    Args:
        watched: The arm.
        address: Of the page.

    Attributes:
        address: With the port that was chosen, from `with` on.

    Raises:
        ConfigError: viser is not installed, or, from `with` on, the port is taken.
    """

    def __init__(self, watched: Watched, address: WebAddress) -> None:
        if importlib.util.find_spec("viser") is None:
            raise ConfigError(EXTRA.format(name="viser"))
        self.watched, self.address = watched, address
        self.tick: Tick | None = None
        self.decided: tuple[Tick, Array] | None = None
        self.pi_hat: Array | None = None
        self.event: Event | None = None
        self.copies = 0

    def on_start(self, start: Start, time: float) -> None:
        """Nothing to show yet."""

    def on_tick(self, tick: Tick) -> None:
        """Keeps the turn for the next copy."""
        self.tick = tick
        if tick.decision is not None:
            # q_bar belongs to the rest lengths before the step.
            self.decided = tick, tick.decision.pi_hat if self.pi_hat is None else self.pi_hat
            self.pi_hat = tick.decision.pi_hat

    def on_event(self, event: Event) -> None:
        """Keeps the event for the next copy."""
        self.event = event

    def failure(self) -> str | None:
        """A view that cannot be drawn is no reason to stop."""
        return None

    def __enter__(self) -> LiveView:
        self.address = self.address.free()
        context = multiprocessing.get_context("spawn")  # a fork would carry threads over in an unknown state
        memory = RawArray("b", self.watched.sample_type().itemsize)
        self.sample = _sample(memory, self.watched)
        self.lock, self.closed = context.Lock(), threading.Event()
        here, there = context.Pipe(duplex=False)
        arguments = (self.watched, self.address, memory, self.lock, there, os.getpid())
        self.process = context.Process(target=serve, args=arguments, name="view", daemon=True)
        with deaf_children():
            self.process.start()
        there.close()
        said = _answer(here)
        if said is not None:
            self.process.kill()
            raise ConfigError(said)
        log.info("%s shows the run", self.address.url)
        self.thread = threading.Thread(target=self._copy_on, name="view", daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self.closed.set()
        self.thread.join()
        self._copy()  # how it ended
        # A plain number: an event of two processes waits for the other one, which may have been ended.
        self.sample["over"] = 1
        self.process.join(WAIT)
        self.process.kill()
        self.process.join()

    def _copy_on(self) -> None:
        while not self.closed.wait(FRAME):
            self._copy()

    def _copy(self) -> None:
        tick, decided, event = self.tick, self.decided, self.event
        # Where the page's process was ended while it held the lock, nobody looks any more.
        if not self.lock.acquire(timeout=FRAME):
            return
        try:
            if event is not None:
                self.sample["state"], self.sample["message"] = event.state.value.encode(), _text(event.message)
            if tick is not None:
                self.sample["time"], self.sample["overruns"] = tick.time, tick.overruns
                if tick.reading is not None:
                    self.sample["effort"] = tick.reading.effort
            if decided is not None:
                _write(self.sample, *decided)
                self.copies += 1
                self.sample["count"] = self.copies
        finally:
            self.lock.release()


def _write(sample: NDArray[np.void], tick: Tick, pi_hat: Array) -> None:
    sample["pi_hat"] = pi_hat
    for name in ("q_bar", "x_d", "e"):
        sample[name] = getattr(tick.decision, name)
    frame = tick.frame
    if frame is not None:
        seen = frame.position_ok & frame.orientation_ok
        sample["T"] = np.where(seen[:, None, None], frame.T, np.nan)


def _text(message: str) -> bytes:
    return for_terminal(message).encode("ascii", "replace")[:160]


def _sample(memory: ctypes.Array[ctypes.c_byte], watched: Watched) -> NDArray[np.void]:
    sample: NDArray[np.void] = np.ctypeslib.as_array(memory).view(watched.sample_type()).reshape(())
    return sample


def _answer(ready: Connection) -> str | None:
    """What the process says of its beginning; None where all is well."""
    try:
        said = ready.recv() if ready.poll(START_TIMEOUT) else f"the view did not begin within {START_TIMEOUT:g} s"
    except EOFError:
        said = "the view's process ended before it began"
    finally:
        ready.close()
    return said or None


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
        sample = _sample(memory, watched)
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
        self.panel.draw_error(np.zeros(0), np.zeros(0))
        self.panel.add_layers(LAYERS, MODELLED_ARM)
        self.times: deque[float] = deque()
        self.errors: deque[float] = deque()
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
            self._keep(float(sample["time"]), error)
            numbers |= self._numbers(sample, error)
            self.panel.draw_error(np.array(self.times), np.array(self.errors))
        self.panel.tell(numbers)

    def _numbers(self, sample: NDArray[np.void], error: float) -> dict[str, str]:
        x, y, z = 1e3 * sample["x_d"]
        return {
            "time": f"{float(sample['time']):.1f} s",
            "error of the tip": f"{error:.1f} mm",
            "target": f"{x:.0f}, {y:.0f}, {z:.0f} mm",
            "believed lengths": ", ".join(f"{1e3 * v:.0f}" for v in sample["pi_hat"]) + " mm",
            "highest tension": f"{float(sample['effort'].max()):.1f} N",
            "missed deadlines": f"{int(sample['overruns'])}",
        }

    def _keep(self, at: float, error: float) -> None:
        if self.times and at <= self.times[-1]:
            return
        self.times.append(at)
        self.errors.append(error)
        while self.times[-1] - self.times[0] > KEPT:
            self.times.popleft()
            self.errors.popleft()

    def _moment(self, sample: Any) -> Moment:
        q, pi_hat = torch.from_numpy(sample["q_bar"]), torch.from_numpy(sample["pi_hat"])
        sections, tendons = self.watched.outline(q, pi_hat)
        poses: Array = sample["T"]
        return Moment(sections, tendons, sample["effort"], poses, target=sample["x_d"])
