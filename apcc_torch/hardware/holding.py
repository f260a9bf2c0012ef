"""The end under torque: hold the arm for a while, still watched, or let go."""

from __future__ import annotations

from apcc_torch.errors import CommunicationError, HardwareError
from apcc_torch.hardware.guards import Guards
from apcc_torch.hardware.journal import Journal
from apcc_torch.hardware.loop import Loop
from apcc_torch.hardware.records import Tick
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Ending, Halt, Stop, StopReason, halt_if


def hold(setup: Setup, journal: Journal, guards: Guards, loop: Loop, stop: Stop) -> Stop | None:
    """Holds the arm where it is for the configured time, or until the run is asked to stop once more.

    Args:
        setup: The parts.
        journal: Told of every turn.
        guards: They go on; a stop that leads to torque off ends the hold.
        loop: The loop that ended.
        stop: Why it did.

    Returns:
        What ended the hold before its time, or kept it from beginning; None if nothing did.
    """
    clock, settings = setup.clock, setup.loop
    asked = setup.request.count
    try:
        setup.actuator.hold()
        journal.to(
            State.HOLD,
            f"held for {settings.hold:g} s or until asked again, then torque goes off and the arm drops",
            stop.reason,
        )
        begin = clock.now()
        k = 0
        while clock.now() < begin + settings.hold and setup.request.count == asked:
            k += 1
            clock.wait_until(begin + k * settings.period)
            _watch(setup, journal, guards, loop, begin + k * settings.period)
    except Halt as halt:
        return halt.stop
    except CommunicationError as error:
        return Stop(StopReason.COMMUNICATION, str(error))
    except HardwareError as error:
        return Stop(StopReason.DEVICE_FAULT, str(error))
    return None


def _watch(setup: Setup, journal: Journal, guards: Guards, loop: Loop, deadline: float) -> None:
    """One turn: the tendons are read, which also keeps the motors' watchdogs quiet."""
    now = setup.clock.now()
    time = now - loop.started_at
    index = round((deadline - loop.started_at) * setup.loop.rate)
    tick = Tick(index, now, time, deadline, now - deadline, journal.state, loop.sent, loop.sent)
    try:
        tick.reading = setup.actuator.read()
    except CommunicationError as error:
        journal.event("exchange_failed", str(error))
        halt_if(guards.on_failed_read(error))
    tick.read = setup.clock.now() - now
    journal.tick(tick)
    stop = None if tick.reading is None else guards.on_reading(tick.reading, now)
    if stop is not None and setup.guards.ending(stop.reason) is Ending.TORQUE_OFF:
        raise Halt(stop)


def let_go(setup: Setup, journal: Journal) -> bool:
    """Torque off; False if even that failed, and only the motors' own watchdog is left."""
    try:
        setup.actuator.torque_off()
    except HardwareError as error:
        journal.event("error", f"torque off failed, the motors' own watchdog must stop them: {error}")
        return False
    return True
