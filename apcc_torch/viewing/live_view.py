"""A run on an arm, live: shown by a process of its own, so that the loop's timing does not feel it.

The loop hands over nothing but a reference. Some twenty times a second a thread copies the last turn into memory that
the two processes share; turns in between are not shown.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import threading
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.control import Start
from apcc_torch.hardware.records import Event, Observer, Tick
from apcc_torch.plain_text import for_terminal, plain_logger
from apcc_torch.processes import deaf_children
from apcc_torch.viewing.live_page import live_page
from apcc_torch.viewing.live_process import FRAME, Showing, Watched, sample_in, serve
from apcc_torch.viewing.moment import Array
from apcc_torch.viewing.page import EXTRA
from apcc_torch.web_address import WebAddress

log = plain_logger(__name__)

START_TIMEOUT = 120.0
"""Longest that the process may take to begin, s: it imports torch."""
WAIT = 5.0
"""Longest wait for its end, s."""
PAGE = Showing("viser", EXTRA, live_page)
"""On a page in the browser."""


class LiveView(Observer):
    """Observes a run, and shows it as long as `with` lasts.

    Args:
        watched: The arm.
        address: Where it is served.
        showing: How.
        offset: What turns the run's clock into seconds since 1970.

    Attributes:
        address: With the port that was chosen, from `with` on.

    Raises:
        ConfigError: The library that shows it is not installed, or, from `with` on, the port is taken.
    """

    def __init__(self, watched: Watched, address: WebAddress, showing: Showing = PAGE, offset: float = 0.0) -> None:
        if importlib.util.find_spec(showing.library) is None:
            raise ConfigError(showing.missing)
        self.watched, self.address, self.showing, self.offset = watched, address, showing, offset
        self.began = 0
        self.tick: Tick | None = None
        self.decided: tuple[Tick, Array] | None = None
        self.pi_hat: Array | None = None
        self.event: Event | None = None
        self.copies = 0

    def on_start(self, start: Start, time: float) -> None:
        """Keeps when the run's time was zero; there is nothing to show yet."""
        self.began = max(round(1e9 * time) + round(1e9 * self.offset), 0)

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

    def __enter__(self) -> LiveView:
        self.address = self.address.free()
        context = multiprocessing.get_context("spawn")  # a fork would carry threads over in an unknown state
        memory = RawArray("b", self.watched.sample_type().itemsize)
        self.sample = sample_in(memory, self.watched)
        self.lock, self.closed = context.Lock(), threading.Event()
        here, there = context.Pipe(duplex=False)
        arguments = (self.showing.make, self.watched, self.address, memory, self.lock, there, os.getpid())
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
                self.sample["began"] = self.began
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
    sample["stamp"] = tick.decision.time if tick.decision is not None else np.nan
    for name in ("q_bar", "x_d", "e"):
        sample[name] = getattr(tick.decision, name)
    frame = tick.frame
    if frame is not None:
        seen = frame.position_ok & frame.orientation_ok
        sample["T"] = np.where(seen[:, None, None], frame.T, np.nan)


def _text(message: str) -> bytes:
    return for_terminal(message).encode("ascii", "replace")[:160]


def _answer(ready: Connection) -> str | None:
    """What the process says of its beginning; None where all is well."""
    try:
        said = ready.recv() if ready.poll(START_TIMEOUT) else f"the view did not begin within {START_TIMEOUT:g} s"
    except EOFError:
        said = "the view's process ended before it began"
    finally:
        ready.close()
    return said or None
