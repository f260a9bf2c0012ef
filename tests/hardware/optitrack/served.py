"""A NatNet server for a test module, and sensors that are connected to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.mocap.tracker import MocapSample
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from hardware.emulators.mocap_server import standing
from hardware.emulators.natnet_server import NatNetServer
from hardware.optitrack.streams import settings

RATE = 200.0


def renew(server: NatNetServer, **options: object) -> None:
    """The server as it was started, whatever the test before did to it."""
    server.fault()
    server.restart(**{"version": (4, 1), "names": server.options.names, "poses": standing(4), "ticks": True, **options})


def sensor_for(server: NatNetServer, **changes: object) -> OptiTrackSensor:
    """A sensor with limits that a busy computer keeps."""
    given: dict[str, object] = {"base_frames": 5, "max_age": 0.5, "timeout": 0.9, **changes}
    return OptiTrackSensor(settings(command_port=server.command_port, **given))


@contextmanager
def connected(server: NatNetServer, **changes: object) -> Iterator[OptiTrackSensor]:
    with sensor_for(server, **changes) as sensor:
        yield sensor
        assert sensor.counts().failed == 0


def eventually(condition: Callable[[], bool], timeout: float = 5.0) -> bool:
    """Whether the condition comes true in time."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return condition()


def all_valid(sensor: OptiTrackSensor) -> bool:
    """Whether the source lives and its newest sample is valid throughout."""
    try:
        sample = sensor.latest()
    except HardwareError:
        return False
    return sample is not None and bool(sample.valid.all())


def sample_beyond(sensor: OptiTrackSensor, sequence: int, timeout: float = 5.0) -> MocapSample:
    """The first sample that is seen with a frame number above `sequence`."""
    end = time.monotonic() + timeout
    sample = sensor.latest()
    while (sample is None or sample.sequence <= sequence) and time.monotonic() < end:
        sample = sensor.wait(0.1, after=None if sample is None else sample.sequence) or sample
    assert sample is not None and sample.sequence > sequence
    return sample


def next_sample(sensor: OptiTrackSensor, frames: int = 1) -> MocapSample:
    """The sample of some frames later."""
    sample = sensor.latest()
    for _ in range(frames):
        sample = sensor.wait(2.0, after=None if sample is None else sample.sequence)
        assert sample is not None
    assert sample is not None
    return sample
