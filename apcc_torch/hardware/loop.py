"""The loop under torque: on absolute deadlines, read, sense, decide, clamp, send."""

from __future__ import annotations

from dataclasses import replace

from apcc_torch.errors import ApccError, CommunicationError, HardwareError
from apcc_torch.hardware.guards import Guards
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.journal import Journal
from apcc_torch.hardware.records import Tick
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Halt, Stop, StopReason, halt_if


class Loop:
    """Turns until one halts.

    Args:
        setup: The parts.
        journal: Told of every turn.
        guards: Their memory; it goes on in the hold after the loop.
        sent: (n_a,) the lengths that count as sent, m.

    Attributes:
        started_at: Zero of the run's time, s. ticks: Turns so far. overruns: Missed deadlines so far: those that had
            passed when they could be served, a late one that was served among them.
    """

    def __init__(self, setup: Setup, journal: Journal, guards: Guards, sent: Array) -> None:
        self.setup = setup
        self.journal = journal
        self.guards = guards
        self.requested = self.sent = sent
        self.lengths: Array | None = None  # as last measured, m
        # What the motors may have been told last, and when, s. After a command that failed nobody knows: it may have
        # come through all the same.
        self.standing = [(sent, setup.clock.now())]
        self.started_at = self.standing[0][1] + setup.loop.period
        self.seen_at = self.standing[0][1]  # when the loop was last seen to move, s
        self.ticks = 0
        self.overruns = 0

    def run(self) -> None:
        """Never returns.

        Raises:
            Halt: The run stops.
            HardwareError: A motor reports a fault.
        """
        clock, loop = self.setup.clock, self.setup.loop
        self.setup.sensing.begin(self.started_at)
        self.journal.start(self.setup.control.start(0.0), self.started_at)
        self.journal.to(State.RUNNING, f"running at {loop.rate:g} Hz")
        k = 0
        while True:
            deadline = self.started_at + k * loop.period
            clock.wait_until(deadline)
            before = self.overruns
            try:
                self.turn(k, deadline)
                self.ticks += 1
            finally:
                k = self._next(k + 1)
            self._alive()
            halt_if(self.guards.on_overrun(self.overruns - before, self.seen_at))
            self.setup.control.look_ahead(clock.now, self.started_at + k * loop.period)

    def _next(self, k: int) -> int:
        """The deadline to serve, where `k` is the next: the latest that has passed, at once; those before are lost."""
        late = self.setup.clock.now() - self.started_at
        if late <= k * self.setup.loop.period:
            return k
        latest = max(k, int(late * self.setup.loop.rate))
        self.overruns += latest - k + 1
        return latest

    def _alive(self) -> None:
        """Halts if the loop has stood still for too long, wherever in the turn that was."""
        before, self.seen_at = self.seen_at, self.setup.clock.now()
        halt_if(self.guards.on_pause(self.seen_at - before))

    def turn(self, k: int, deadline: float) -> None:
        """One turn. Its record is kept however it ends."""
        now = self.setup.clock.now()
        tick = Tick(
            k, now, now - self.started_at, deadline, now - deadline, self.journal.state, self.requested, self.sent
        )
        try:
            self._alive()
            halt_if(self.setup.request.stop)
            halt_if(self.journal.failure())
            if tick.time >= self.setup.duration:
                raise Halt(Stop(StopReason.DURATION, f"{self.setup.duration:g} s are over"))
            self._read(tick)
            self._sense(tick)
            self._decide(tick)
            self._alive()
            halt_if(self.setup.sensing.missing(self.setup.clock.now()))
            self._send(tick)
        finally:
            tick.overruns, tick.failed = self.overruns, self.guards.failed
            self.journal.tick(tick)

    def _read(self, tick: Tick) -> None:
        clock = self.setup.clock
        began = clock.now()
        try:
            tick.reading = self.setup.actuator.read()
        except CommunicationError as error:
            self.journal.event("exchange_failed", str(error))
            halt_if(self.guards.on_failed_read(error))
        tick.read = clock.now() - began
        if tick.reading is not None:
            self.lengths = tick.reading.y
            halt_if(self.guards.on_reading(tick.reading, clock.now()))

    def _sense(self, tick: Tick) -> None:
        clock = self.setup.clock
        began = clock.now()
        try:
            sample = self.setup.sensor.latest()
        except HardwareError as error:
            raise Halt(Stop(StopReason.SENSOR_LOST, str(error))) from error
        tick.frame = self.setup.sensing.look(sample, clock.now())
        tick.sense = clock.now() - began

    def _decide(self, tick: Tick) -> None:
        """Steps the controller where there is a new frame to step on; elsewhere its last wish stands.

        Where the tendons could not be read in this turn, their last lengths serve.
        A frame is judged by its age once more before the step and after it: the program may have been held up since.
        """
        frame = tick.frame
        if frame is None or not frame.usable or self.lengths is None:
            return
        clock = self.setup.clock
        began = clock.now()
        if not self.setup.sensing.in_time(frame, began):
            tick.frame = replace(frame, age=began - frame.stamp, usable=False)
            return
        try:
            tick.decision = self.setup.control.decide(frame, self.lengths, frame.stamp - self.started_at)
        except ApccError as error:
            raise Halt(Stop(StopReason.CONTROLLER_ERROR, str(error))) from error
        tick.control = clock.now() - began
        halt_if(self.guards.on_decision(tick.decision, clock.now()))
        if self.setup.sensing.in_time(frame, clock.now()):
            self.requested = tick.requested = tick.decision.command

    def _send(self, tick: Tick) -> None:
        """Sends what the limits leave of the last wish: one out of reach is approached turn by turn."""
        self._alive()
        clock, actuator, limits = self.setup.clock, self.setup.actuator, self.setup.limits
        began = clock.now()
        # Each was within reach of those before it, so what is left is within reach of them all.
        y = actuator.rounded(*limits.clamp(self.requested, *((last, began - at) for last, at in self.standing)))
        try:
            self.sent = tick.sent = actuator.send(y)
            self.standing = [(self.sent, began)]
            tick.fresh = True
            self.guards.on_sent()
        except CommunicationError as error:
            self.standing.append((y, began))
            self.journal.event("exchange_failed", str(error))
            halt_if(self.guards.on_failed_send(error))
        ended = clock.now()
        tick.send = ended - began
        if tick.fresh and tick.decision is not None and tick.frame is not None:
            tick.latency = ended - tick.frame.stamp
