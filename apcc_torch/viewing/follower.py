"""An arm that follows, in real time, a target that is dragged on a page."""

from __future__ import annotations

import threading
import time

from apcc_torch.model.arm_scale import largest_payload
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.panel import TOLD, Panel, numbers_of
from apcc_torch.viewing.pursuit import Pursuit
from apcc_torch.viewing.recent_errors import RecentErrors
from apcc_torch.viewing.scene import LAYERS, Scene

FRAME = 0.04
"""s between two pictures."""
LAG = 0.1
"""s that the arm may be late before it gives them up: an arm slower than real time goes on as fast as it can."""


class Follower:
    """A page with a simulated arm, its target and controls.

    Args:
        page: Empty.
        pursuit: The arm in its loop.

    Attributes:
        paused: Whether time stands still.
        control: The target that can be dragged.
        rate: Simulated seconds in one of the wall's.
    """

    def __init__(self, page: Page, pursuit: Pursuit) -> None:
        self.page, self.pursuit = page, pursuit
        arm = pursuit.arm
        self.scene = Scene(page, *DrawnSize.of(arm))
        self.scene.show(pursuit.moment())
        self.control = self.scene.target_control(pursuit.target)
        self.first_target = pursuit.target
        self.paused, self.rate = False, 0.0
        self._reset = threading.Event()
        self.errors = RecentErrors()
        self.panel = Panel(page, self.scene, arm.n_sections)
        self._add_controls()
        self._tell()
        self.panel.add_layers(LAYERS)

    def _add_controls(self) -> None:
        gui, pursuit = self.page.server.gui, self.pursuit
        self.control.on_update(lambda _: self._follow())
        self.pause = gui.add_button("Pause")
        self.pause.on_click(lambda _: self._toggle())
        reset = gui.add_button("Reset", color="gray")
        reset.on_click(lambda _: self._reset.set())
        most = max(float(f"{1.5 * largest_payload(pursuit.arm):.2g}"), pursuit.payload)
        self.payload = gui.add_slider(
            "payload (kg)", 0.0, most, most / 100.0, pursuit.payload, hint="at the tip; the controller is not told"
        )
        self.payload.on_update(lambda _: setattr(pursuit, "payload", float(self.payload.value)))

    def _follow(self) -> None:
        self.pursuit.target = self.control.position

    def aim(self, target: Array) -> None:
        """Puts the target to (3,) m, as if it were dragged there."""
        self.control.position = tuple(float(v) for v in target)
        self._follow()

    def advance(self, steps: int = 1) -> None:
        """So many control periods, as fast as they are computed."""
        for _ in range(steps):
            self.pursuit.step()
        self._keep()

    def show(self) -> None:
        """Shows the arm and the numbers as they are."""
        self.scene.show(self.pursuit.moment())
        self._tell()

    def _toggle(self) -> None:
        self.paused = not self.paused
        self.pause.label = "Go on" if self.paused else "Pause"

    def run(self, over: threading.Event) -> None:
        """Steps the arm in real time and shows it, until it is over."""
        period = self.pursuit.period
        now = time.monotonic()
        due, shown, told, begun = now, now, now, (now, self.pursuit.time)
        while not over.is_set():
            if self._reset.is_set():
                self._begin_anew()
                begun = (time.monotonic(), 0.0)
            if not self.paused:
                self.pursuit.step()
            now = time.monotonic()
            if now >= shown:
                self.scene.show(self.pursuit.moment())
                shown = now + FRAME
            if now >= told:
                if not self.paused:
                    self.rate = (self.pursuit.time - begun[1]) / max(now - begun[0], 1e-9)
                    self._keep()
                begun, told = (now, self.pursuit.time), now + TOLD
                self._tell()
            due = max(due + period, now - LAG)
            over.wait(max(due - time.monotonic(), 0.0))

    def _begin_anew(self) -> None:
        self._reset.clear()
        self.pursuit.reset()
        self.aim(self.first_target)
        self.errors.clear()

    def _keep(self) -> None:
        self.errors.keep(self.pursuit.time, 1e3 * self.pursuit.error)

    def _tell(self) -> None:
        pursuit = self.pursuit
        numbers = {
            "time": f"{pursuit.time:.1f} s",
            **({"speed": "paused" if self.paused else f"{self.rate:.2f} of real time"} if self.rate else {}),
            "error of the tip": "it left all bounds: reset" if pursuit.diverged else f"{1e3 * pursuit.error:.1f} mm",
            **numbers_of(pursuit.target, pursuit.pi_hat, float(pursuit.tension.max())),
        }
        self.panel.tell(numbers)
        self.panel.draw_error(*self.errors.curve())
