"""A live view in the terminal, drawn ten times a second by a thread of its own from the last turn of the loop."""

from __future__ import annotations

import threading
from typing import TextIO

import numpy as np

from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.records import Event, Observer, Tick
from apcc_torch.plain_text import for_terminal

PERIOD = 0.1
"""s between two pictures."""
HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
OTHER_SCREEN, OWN_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
WIDTH = 40


def bar(value: float, full: float, width: int = WIDTH) -> str:
    """A bar of # for a share of `full`."""
    share = min(max(value / full, 0.0), 1.0) if np.isfinite(value) else 1.0
    return ("#" * round(share * width)).ljust(width, "·")


def row(values: Array, scale: float) -> str:
    """Numbers in one line."""
    return " ".join(f"{scale * float(v):8.2f}" for v in values)


def picture(tick: Tick | None, last: Tick | None, event: Event | None, full: float = 0.3) -> list[str]:
    """The lines of one picture.

    Args:
        tick: The last turn.
        last: The last turn with a step of the controller.
        event: The last event.
        full: Position error of a full bar, m.
    """
    lines = ["apcc_torch robot                                  Ctrl-C: stop and hold, again: torque off", ""]
    if event is None:
        lines.append("state     DISARMED   connecting")
    else:
        lines.append(f"state     {event.state.value.upper():<10} {event.message[:90]}")
    if tick is None:
        return lines
    lines.append(f"time      {tick.time:8.2f} s    turn {tick.index}")
    decision = None if last is None else last.decision
    if decision is not None:
        error = float(np.linalg.norm(decision.e))
        lines.append(f"error     {1e3 * error:8.2f} mm   {bar(error, full)}")
        lines.append(f"target    {row(decision.x_d, 1e3)} mm")
        lines.append(f"pi-hat    {row(decision.pi_hat, 1e3)} mm")
        lines.append(f"residual  {row(decision.linear_error, 1e3)} mm a body")
    pressures = decision is not None and decision.pressure is not None
    name, scale, unit = ("pressure", 1e-3, "kPa") if pressures else ("tendons ", 1e3, "mm")
    if tick.reading is not None:
        lines.append(f"tension   {row(tick.reading.effort, 1.0)} N")
        lines.append(f"{name}  {row(tick.reading.y, scale)} {unit}")
    lines.append(f"sent      {row(tick.sent, scale)} {unit}")
    late = f"late      {1e6 * tick.lateness:8.0f} us   missed deadlines {tick.overruns}, failed exchanges {tick.failed}"
    lines.append(late)
    if last is not None and last.latency is not None:
        lines.append(f"latency   {1e3 * last.latency:8.2f} ms   of it the controller {1e3 * last.control:.2f} ms")
    return lines


class TerminalView(Observer):
    """Observes a run. `with` takes the terminal's other screen, and gives it back."""

    def __init__(self, terminal: TextIO) -> None:
        self.terminal = terminal
        self.tick: Tick | None = None
        self.last: Tick | None = None
        self.event: Event | None = None
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._work, name="view", daemon=True)

    def on_tick(self, tick: Tick) -> None:
        """Keeps the turn for the next picture."""
        self.tick = tick
        if tick.decision is not None:
            self.last = tick

    def on_event(self, event: Event) -> None:
        """Keeps the event for the next picture."""
        self.event = event

    def __enter__(self) -> TerminalView:
        self.terminal.write(OTHER_SCREEN)
        self.thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self.over.set()
        self.thread.join()
        self.terminal.write(OWN_SCREEN)
        self.terminal.flush()

    def _work(self) -> None:
        while not self.over.wait(PERIOD):
            lines = picture(self.tick, self.last, self.event)
            self.terminal.write(HOME + "".join(f"{for_terminal(line)}{CLEAR_LINE}\r\n" for line in lines) + CLEAR_BELOW)
            self.terminal.flush()
