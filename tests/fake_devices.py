"""Devices in memory on a virtual clock, with faults at given times: what the runner's own tests run on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf

import numpy as np
import torch

from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError, ValueRangeError
from apcc_torch.estimation.feedback import Feedback
from apcc_torch.hardware.clock import VirtualClock
from apcc_torch.hardware.interfaces import PoseSample, PoseSensor, TendonActuator, TendonReading
from apcc_torch.hardware.records import Event, Tick
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import StopReason

N_TENDONS, N_BODIES = 9, 3
TICK = 7e-4  # m, of motors that go in steps as coarse as a third of what a command may change


@dataclass(frozen=True)
class Fault:
    """A fault of a kind, from a time until another, s of the clock."""

    kind: str
    begin: float
    end: float = inf


class Faults:
    """What is wrong at a time."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self.faults = tuple(faults)

    def at(self, kind: str, now: float) -> bool:
        """Whether a fault of the kind is on."""
        return any(fault.kind == kind and fault.begin <= now < fault.end for fault in self.faults)


class FakeActuator(TendonActuator):
    """Motors that are where they were last sent; keeps every command with its time, and whether there was torque."""

    def __init__(self, clock: VirtualClock, faults: Faults) -> None:
        self.clock = clock
        self.faults = faults
        self.n_tendons = N_TENDONS
        self.y = np.full(N_TENDONS, -3 * TICK)
        self.torque = self.connected = self.held = False
        self.commands: list[tuple[float, np.ndarray, bool]] = []
        self.armed = (self.y, 0.0)  # where it was, and when, as torque went on

    def connect(self) -> None:
        if self.faults.at("no_device", self.clock.now()):
            raise HardwareError("motor 4 is of model 1020, not 1030")
        self.connected = True

    def calibrate(self) -> dict[str, object]:
        return {}

    def restore(self, found: Mapping[str, object]) -> None:
        if self.faults.at("lost_zero", self.clock.now()):
            raise HardwareError("motor 5 lost power since that calibration")

    def arm(self) -> None:
        if self.faults.at("arm_fails", self.clock.now()):
            raise DeviceFaultError("motor 2 refuses torque")
        self.torque, self.armed = True, (self.y, self.clock.now())
        if self.faults.at("arm_moves", self.clock.now()):
            self.y = self.y - 0.01

    def read(self) -> TendonReading:
        now = self.clock.now()
        if self.faults.at("read_fails", now):
            raise CommunicationError("motor 7 does not answer")
        if self.faults.at("motor_fault", now):
            raise DeviceFaultError("motor 3: overload")
        effort = np.full(N_TENDONS, 5.0)
        effort[4] += 60.0 * self.faults.at("effort", now) + 500.0 * self.faults.at("effort_peak", now)
        effort[6] -= 5.0 * self.faults.at("slack", now)
        effort[1] += np.nan if self.faults.at("effort_nan", now) else 0.0
        y = self.y + 0.5 * self.faults.at("slipped", now)
        y[8] += np.nan if self.faults.at("reading_nan", now) else 0.0
        return TendonReading(now, y, np.zeros(N_TENDONS), effort, {"position": [0] * N_TENDONS})

    def rounded(self, y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        if not self.faults.at("coarse", 0.0):
            return y
        return np.clip(np.rint(y / TICK), np.ceil(low / TICK - 1e-9), np.floor(high / TICK + 1e-9)) * TICK

    def send(self, y: np.ndarray) -> np.ndarray:
        if self.faults.at("coarse", 0.0):
            y = np.rint(y / TICK) * TICK
        if self.faults.at("send_fails", self.clock.now()):
            raise CommunicationError("the port is gone")
        self.commands.append((self.clock.now(), y.copy(), self.torque and not self.held))
        self.y = y.copy()
        if self.faults.at("send_unsure", self.clock.now()):
            raise CommunicationError("the port was gone as the packet ended")
        return y

    def hold(self) -> None:
        if self.faults.at("hold_fails", self.clock.now()):
            raise CommunicationError("the port is gone")
        self.held = True

    def torque_off(self) -> None:
        self.torque = False
        if self.faults.at("torque_off_fails", self.clock.now()):
            raise CommunicationError("the port is gone")

    def disconnect(self) -> None:
        self.torque = self.connected = False


class FakeSensor(PoseSensor):
    """Three bodies of a resting arm that hangs from its base, a little noise on them, a frame every 10 ms."""

    period = 0.01

    def __init__(self, clock: VirtualClock, faults: Faults, rest: np.ndarray) -> None:
        self.clock = clock
        self.faults = faults
        self.rest = rest
        self.n_bodies = N_BODIES
        self.connected = False

    def connect(self) -> None:
        if self.faults.at("no_sensor", self.clock.now()):
            raise HardwareError("no stream on 127.0.0.1:1511")
        self.connected = True

    def latest(self) -> PoseSample:
        now = self.clock.now()
        if self.faults.at("stream_ended", now):
            raise HardwareError("the stream has ended")
        frozen = [f.begin for f in self.faults.faults if f.kind == "frozen" and f.begin <= now < f.end]
        number = int(np.floor(min([now, *frozen]) / self.period + 1e-9))
        stamp = number * self.period - 1.0 * self.faults.at("late", now)
        noise = 0.0 if self.faults.at("repeating", now) else 1e-5 * np.random.default_rng(number).standard_normal(3)
        T = self.rest.copy()
        T[:, :3, 3] += noise
        valid = np.ones(N_BODIES, dtype=np.bool_)
        if self.faults.at("jump", now):
            T[:, :3, 3] += 0.3
        if self.faults.at("swapped", now):
            T = T[::-1].copy()
        if self.faults.at("nan", now):
            T[:] = np.nan
        if self.faults.at("not_a_rotation", now):
            T[:, :3, :3] = 0.0
        valid[1] = not self.faults.at("one_untracked", now)
        valid &= not self.faults.at("untracked", now)
        return PoseSample(stamp, number, T, valid)

    def wait(self, timeout: float, after: int | None = None) -> PoseSample | None:
        end = self.clock.now() + timeout
        while True:
            sample = self.latest()
            if after is None or sample.sequence > after:
                return sample
            if self.clock.now() >= end:
                return None
            self.clock.wait_until(self.clock.now() + 0.002)

    def disconnect(self) -> None:
        self.connected = False


class FakeStep:
    """A controller's step that wants what it is told to, and may fail, dawdle or ask the run to stop."""

    def __init__(self, clock: VirtualClock, faults: Faults, request: StopRequest) -> None:
        self.clock = clock
        self.faults = faults
        self.request = request
        self.calls = 0
        self.tendons: list[np.ndarray] = []

    def __call__(
        self, state: ControllerState, measurement: Measurement, target: Target
    ) -> tuple[ControllerState, Command]:
        now = self.clock.now()
        self.calls += 1
        assert measurement.tendons is not None
        self.tendons.append(measurement.tendons.numpy().copy())
        y = torch.full((N_TENDONS,), -0.01, dtype=torch.float64)
        e = torch.full((3,), 0.1, dtype=torch.float64)
        if self.faults.at("wild", now):
            y = 10.0 * torch.sin(torch.arange(N_TENDONS) + 37.0 * now).double()
        if self.faults.at("turned_round", now):
            y = -y
        if self.faults.at("command_nan", now):
            y[3] = torch.nan
        if self.faults.at("diverged", now):
            e = e + 3.0
        if self.faults.at("arrived", now):
            e = e * 1e-3
        if self.faults.at("refuses", now):
            raise ValueRangeError("q must be finite")
        if self.faults.at("bug", now):
            raise RuntimeError("index out of range")
        for kind, seconds in (("slow", 0.037), ("stopped", 0.5)):
            if self.faults.at(kind, now):
                self.clock.wait_until(now + seconds)
        for kind, reason in (("ctrl_c", StopReason.INTERRUPTED), ("sigterm", StopReason.TERMINATED)):
            if self.faults.at(kind, now):
                self.request.ask(reason, kind)
        k = torch.zeros(N_BODIES, dtype=torch.float64)
        feedback = Feedback(state.q_bar, k, k, torch.tensor(1), torch.tensor(0))
        return state._replace(time=measurement.time), Command(state.qdot, state.q_d, y, e, feedback)


class Witness:
    """Observes a run; may say that it failed."""

    def __init__(self, clock: VirtualClock, faults: Faults) -> None:
        self.clock = clock
        self.faults = faults
        self.ticks: list[Tick] = []
        self.events: list[Event] = []

    def on_start(self, start: object, time: float) -> None:
        self.zero = time

    def on_tick(self, tick: Tick) -> None:
        self.ticks.append(tick)

    def on_event(self, event: Event) -> None:
        self.events.append(event)

    def failure(self) -> str | None:
        return "No space left on device" if self.faults.at("disk_full", self.clock.now()) else None
