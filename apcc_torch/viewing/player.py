"""A finished run on a page, under a time slider."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from apcc_torch.viewing.page import Page
from apcc_torch.viewing.panel import MODELLED_ARM, TOLD, TRUE_ARM, Panel, numbers_of
from apcc_torch.viewing.recorded import Recorded
from apcc_torch.viewing.scene import LAYERS, Scene

FRAME = 0.04
"""s between two pictures."""
SPEEDS = ("0.25", "0.5", "1", "2", "5")
PLOTTED = 600
"""Most instants that the plot shows."""


class Player:
    """A page with a run, a slider over its time, and controls.

    Args:
        page: Empty.
        run: What is shown.
        row: Which row first.

    Attributes:
        playing: Whether time goes on. time: s, that is shown. end: s, of the run.
    """

    def __init__(self, page: Page, run: Recorded, row: int = 0) -> None:
        self.page, self.run_shown, self.row = page, run, row
        self.scene = Scene(page, *run.size)
        self.playing = False
        self.time, self.end = float(run.time[0]), float(run.time[-1])
        self.changed = threading.Event()
        self.changed.set()
        self.panel = Panel(page, self.scene, run.sections)
        self._add_controls()
        self._show()
        self.panel.add_layers(self._layers(), MODELLED_ARM if run.model is None else TRUE_ARM)

    def _layers(self) -> tuple[str, ...]:
        has = {
            "tendons": self.run_shown.arm.routing is not None,
            "sensors": self.run_shown.abscissae is not None or self.run_shown.poses is not None,
            "uncertainty": self.run_shown.noise > 0.0,
            "model": self.run_shown.model is not None,
        }
        return tuple(layer for layer in LAYERS if has.get(layer, True))

    def _add_controls(self) -> None:
        gui, run = self.page.server.gui, self.run_shown
        begin, end = self.time, self.end
        self.play = gui.add_button("Play")
        self.play.on_click(lambda _: self._toggle())
        step = max((end - begin) / max(len(run.time) - 1, 1), 1e-4)
        self.slider = gui.add_slider("time (s)", begin, max(end, begin + step), step, begin)
        self.slider.on_update(self._move)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="1", hint="times real time")
        if len(run.rows) > 1:
            rows = gui.add_number("row", self.row, min=0, max=len(run.rows) - 1, step=1, hint="of the run's rows")
            rows.on_update(lambda _: self._choose(int(rows.value)))

    def _toggle(self) -> None:
        if not self.playing and self.time >= self.end:
            self.time = float(self.run_shown.time[0])
        self.playing = not self.playing
        self.play.label = "Pause" if self.playing else "Play"

    def _move(self, event: Any) -> None:
        if event.client is not None:  # a person moved it, and not the time that goes on
            self.time = float(self.slider.value)
            self.changed.set()

    def _choose(self, row: int) -> None:
        self.row = row
        self.changed.set()

    def run(self, over: threading.Event) -> None:
        """Shows what the controls ask for, until it is over."""
        before = told = time.monotonic()
        while not over.wait(FRAME):
            now = time.monotonic()
            if self.playing:
                self.time = min(self.time + float(self.speed.value) * (now - before), self.end)
                if self.time >= self.end:
                    self._toggle()
                    told = now
                self.scene.show(self.run_shown.moment(self.run_shown.nearest(self.time), self.row))
                if now >= told:
                    told = now + TOLD
                    self.slider.value = self.time
                    self.changed.set()
            before = now
            if self.changed.is_set():
                self.changed.clear()
                self._show()

    def _show(self) -> None:
        run, row = self.run_shown, self.row
        k = run.nearest(self.time)
        moment = run.moment(k, row)
        self.scene.show(moment)
        tension = None if moment.tension is None else float(np.nanmax(moment.tension))
        numbers = {"time": f"{float(run.time[k]):.2f} of {float(run.time[-1]):.2f} s"}
        if run.rows[row]:
            numbers["row"] = run.rows[row]
        numbers["error of the tip"] = f"{1e3 * float(run.error[k, row]):.2f} mm"
        numbers |= numbers_of(run.x_d[k, row].numpy(), run.pi_hat[k, row].tolist(), tension)
        self.panel.tell(numbers)
        at = np.unique(np.linspace(0, len(run.time) - 1, PLOTTED).astype(int))
        time_, error = run.time.numpy()[at], 1e3 * run.error[:, row].numpy()[at]
        self.panel.draw_error(time_, error, float(run.time[k]))
