"""From connected devices to torque: every condition in order, and nothing moves."""

from __future__ import annotations

import numpy as np

from apcc_torch.errors import SafetyError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.journal import Journal
from apcc_torch.hardware.sensing import GatedFrame
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Halt


def arm(setup: Setup, journal: Journal) -> Array:
    """Checks, warms the controller up, and puts torque on with every goal at the present length.

    Returns:
        (n_a,) the lengths that count as sent, m.

    Raises:
        SafetyError: A condition is not met.
        HardwareError: A device does not answer.
        Halt: The run was asked to stop.
    """
    for check in setup.checks:
        check()
    loop, limits = setup.loop, setup.limits
    reading = setup.actuator.read()
    margin = loop.arm_margin if limits.margin is None else limits.margin
    if not limits.inside(reading.y, margin):
        raise SafetyError(
            f"the {limits.what} are at {limits.shown(reading.y)}, outside their range {limits.shown(limits.lower)} to "
            f"{limits.shown(limits.upper)}"
        )
    took = setup.control.warm_up(complete_frame(setup), reading.y, loop.warm_up, loop.period, setup.clock.now)
    journal.event("warm_up", f"first controller step {1e3 * took[0]:.1f} ms, last {1e3 * took[-1]:.2f} ms")
    if setup.prepared is not None:
        setup.prepared()
    # The warm-up may have taken seconds.
    complete_frame(setup)
    if setup.request.stop is not None:
        raise Halt(setup.request.stop)
    before = setup.actuator.read()
    journal.to(State.ARMED, "torque goes on, every goal at the present length")  # before it does, in case it fails
    setup.actuator.arm()
    after = setup.actuator.read()
    moved = float(np.abs(after.y - before.y).max())
    if not moved <= margin:
        raise SafetyError(f"one of the {limits.what} moved by {limits.shown(moved)} as torque went on")
    return setup.actuator.rounded(limits.nearest(after.y), limits.lower, limits.upper)


def complete_frame(setup: Setup) -> GatedFrame:
    """A frame with every body, the last of enough in a row.

    Raises:
        SafetyError: They did not come in time.
    """
    loop, clock = setup.loop, setup.clock
    end = clock.now() + loop.fresh_timeout
    row, number = 0, None
    reason = "none came"
    while (left := end - clock.now()) > 0:
        sample = setup.sensor.wait(left, number)
        frame = setup.sensing.look(sample, clock.now())
        if sample is not None:
            number = sample.sequence
        if frame is None:
            continue
        row = row + 1 if frame.complete else 0
        if row >= loop.fresh_frames:
            return frame
        if not frame.complete:
            reason = (
                f"the last had age {frame.age:.3f} s, positions {frame.position_ok.tolist()}, "
                f"rotations {frame.orientation_ok.tolist()}"
            )
    raise SafetyError(f"no {loop.fresh_frames} complete frames in a row within {loop.fresh_timeout:g} s: {reason}")
