"""The runner: connect, check, warm up, arm, run, stop, and always leave the motors safe."""

from __future__ import annotations

from contextlib import ExitStack

import torch

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.arming import arm
from apcc_torch.hardware.guards import Guards
from apcc_torch.hardware.holding import hold, let_go
from apcc_torch.hardware.journal import Journal
from apcc_torch.hardware.loop import Loop
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Ending, Halt, Stop, StopReason
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)


class Runner:
    """One run on one arm. It is good for one `run`."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.journal = Journal(setup.clock, setup.observers)
        self.guards = Guards(setup.guards, setup.limits)
        self.loop: Loop | None = None
        self.ended_at = 0.0

    def run(self) -> Outcome:
        """The whole run. Whatever stops it has a name; the motors are without torque when it returns, or raises."""
        stop, ending = Stop(StopReason.INTERNAL_ERROR, "the run did not end"), None
        try:
            with torch.inference_mode(), ExitStack() as devices:
                stop = self._connected(devices)
                self.ended_at = self.setup.clock.now()
                stop, ending = self._end(stop)
        except HardwareError as error:
            # From closing the devices: what stopped the run before stays the reason, if it was a fault.
            self.journal.event("error", f"a device was not closed cleanly: {error}")
            stop = stop if stop.reason.failed else Stop(StopReason.COMMUNICATION, str(error))
        loop = self.loop
        duration = 0.0 if loop is None else max(self.ended_at - loop.started_at, 0.0)
        ticks, overruns = (0, 0) if loop is None else (loop.ticks, loop.overruns)
        self.journal.event("end", stop.message, stop.reason)
        return Outcome(stop.reason, stop.message, ending, self.journal.state, ticks, duration, overruns)

    def _connected(self, devices: ExitStack) -> Stop:
        """Everything up to the stop; the devices are closed by the stack."""
        try:
            # Registered before it is opened: a connection that fails half-way is taken back as well.
            devices.callback(self.setup.actuator.disconnect)
            self.setup.actuator.connect()
            devices.callback(self.setup.sensor.disconnect)
            self.setup.sensor.connect()
        except HardwareError as error:
            return Stop(StopReason.NOT_CONNECTED, str(error))
        self.journal.event("connected", "the devices are connected, without torque")
        try:
            sent = arm(self.setup, self.journal)
            self.loop = Loop(self.setup, self.journal, self.guards, sent)
            self.loop.run()
        except Halt as halt:
            return halt.stop
        except HardwareError as error:
            return Stop(StopReason.NOT_ARMED if self.loop is None else StopReason.DEVICE_FAULT, str(error))
        except Exception as error:
            log.exception("the runner has an error")
            return Stop(StopReason.INTERNAL_ERROR, f"{type(error).__name__}: {error}")
        return Stop(StopReason.INTERNAL_ERROR, "the loop ended without a reason")

    def _end(self, stop: Stop) -> tuple[Stop, Ending | None]:
        """Hold and then torque off, or torque off at once; returns why the run ended, and what was done."""
        self.journal.event("stop", stop.message, stop.reason)
        if self.journal.state is State.DISARMED:
            if stop.reason.failed:
                self.journal.to(State.FAULT, stop.message, stop.reason)
            return stop, None
        ending, broken = Ending.TORQUE_OFF, None
        if self.loop is not None and self.setup.guards.ending(stop.reason) is Ending.HOLD:
            ending, broken = Ending.HOLD, hold(self.setup, self.journal, self.guards, self.loop, stop)
        if broken is not None:
            self.journal.event("hold_ended", broken.message, broken.reason)
            ending = Ending.TORQUE_OFF
            stop = stop if stop.reason.failed else broken
        safe = let_go(self.setup, self.journal)
        # A run that failed but was held has been brought to rest: it ends disarmed, as one that did not fail.
        fault = not safe or (stop.reason.failed and ending is Ending.TORQUE_OFF)
        self.journal.to(State.FAULT if fault else State.DISARMED, "torque is off", stop.reason)
        return stop, ending
