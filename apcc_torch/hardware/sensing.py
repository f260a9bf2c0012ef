"""Between the pose sensor and the controller: which frames are new, in time and moving, and which bodies to believe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.estimation.sensor_gate import GateState, GateVerdict, SensorGate, SensorGateSettings
from apcc_torch.hardware.interfaces import Array, PoseSample
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.stops import Stop, StopReason
from apcc_torch.native.standing import StandingCall
from apcc_torch.settings import OURS, Settings, setting

Judgement = Callable[[GateState, Tensor, Tensor, Tensor], tuple[GateState, GateVerdict]]
"""One frame through the gate: the gate itself, or a compiled form of it."""

GATE = partial(SensorGateSettings, max_speed=2.0, max_angular_rate=16.0, max_bend=3.0)
"""Of an arm under control, which moves faster and bends more than recorded ones."""


@dataclass(frozen=True, kw_only=True)
class SensingSettings(Settings):
    """Frames and bodies to believe."""

    max_age: float = setting(0.25, "s", OURS, "older frames are not used", above=0)
    stale: float = setting(1.0, "s", OURS, "without an accepted position of any body before the run stops", above=0)
    dropout: float = setting(1.0, "s", OURS, "without an accepted position of one body before the run stops", above=0)
    frozen_frames: int | None = setting(
        10, "", OURS, "so many equal frames in a row are a frozen source, and not used; null: never", least=2
    )
    # Where pi_hat has moved a section's end past a sensor, what is left says next to nothing of one section, and a
    # masked step can be far off.
    partial: str = setting(
        "skip",
        "",
        OURS,
        "a frame that lacks a body: skip waits for a whole one, mask steps on the others",
        choices=("skip", "mask"),
    )
    gate: SensorGateSettings = setting(factory=GATE, meaning="which bodies to believe")


@dataclass(frozen=True)
class GatedFrame:
    """A new frame after the gate.

    stamp: s, when it was measured. sequence: The source's number. age: s, when it was looked at.
    T: (k, 4, 4) poses, finite always: a body's last accepted pose where this frame's was not accepted.
    position_ok, orientation_ok: (k,) what to believe. position_reason, orientation_reason: (k,) `Reason` codes.
    usable: Whether the controller may step on it: it is in time, moving, and has the positions it needs.
    """

    stamp: float
    sequence: int
    age: float
    T: Array
    position_ok: NDArray[np.bool_]
    orientation_ok: NDArray[np.bool_]
    position_reason: NDArray[np.int64]
    orientation_reason: NDArray[np.int64]
    usable: bool

    @property
    def complete(self) -> bool:
        """Whether every body's whole pose was accepted."""
        return self.usable and bool(self.position_ok.all() and self.orientation_ok.all())


def blank_frame(gate: SensorGate) -> tuple[GateState, Tensor, Tensor, Tensor]:
    """Arguments of the form that a gate's every judgement has: what a compiler needs to see."""
    T, time = torch.zeros(gate.sensors, 4, 4, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    return gate.initial_state(T, time), T, torch.zeros(gate.sensors, dtype=torch.bool), time


class Sensing:
    """Judges every frame once, and remembers since when what has been missing.

    Args:
        gate: Which bodies to believe, made of `settings.gate`.
        base_rotation: (3, 3) orientation of the arm's base in the frame of the poses; the gate judges in the base.
        settings: Limits of frames and bodies.
        mounts: How the bodies sit on the arm; None where the source's poses are the model's frames already.
        judge: What to call in place of the gate; None for the gate itself.
    """

    def __init__(
        self,
        gate: SensorGate,
        base_rotation: Tensor,
        settings: SensingSettings,
        mounts: Mounts | None = None,
        judge: Judgement | None = None,
    ) -> None:
        self.gate = gate
        self.settings = settings
        self.mounts = mounts
        # NumPy around the gate: on so few numbers a tensor's every operation costs more than the numbers.
        self.to_base = np.eye(4)
        self.to_base[:3, :3] = base_rotation.detach().double().numpy().T
        self._judge = StandingCall(gate if judge is None else judge, blank_frame(gate), carries=True)
        self.last: PoseSample | None = None
        self.repeats = 0
        self.since_usable = 0.0
        self.since_position = np.zeros(self.gate.sensors)
        self.since_before = self.since_usable, self.since_position  # the last frame

    def begin(self, now: float) -> None:
        """What is missing is counted from now, s."""
        self.since_usable = now
        self.since_position = np.full(self.gate.sensors, now)

    def look(self, sample: PoseSample | None, now: float) -> GatedFrame | None:
        """The sample after the gate, or None if it is no new frame.

        Args:
            sample: The sensor's latest.
            now: s.
        """
        last = self.last
        if sample is None or (last is not None and sample.sequence == last.sequence):
            return None
        self.last = sample
        same = last is not None and sample.T.tobytes() == last.T.tobytes() and bool(sample.valid.any())
        self.repeats = self.repeats + 1 if same else 0
        age = now - sample.stamp
        frozen = self.settings.frozen_frames is not None and self.repeats + 1 >= self.settings.frozen_frames
        forward = last is None or sample.stamp > last.stamp
        # A stamp from the future is as wrong as one from long ago.
        timely = forward and not frozen and -self.settings.max_age <= age <= self.settings.max_age
        poses = sample.T if self.mounts is None else self.mounts.turned(sample.T)
        _, T, tracked, stamp = self._judge.given
        if poses.shape != T.shape:
            raise ShapeError(f"a sample's T must have shape {T.shape}, got {poses.shape}")
        np.matmul(self.to_base, poses, out=T)
        np.logical_and(sample.valid, timely, out=tracked)
        stamp[...] = sample.stamp
        self._judge()
        # Copies: the next frame overwrites what stands there.
        verdict = (array.copy() for array in self._judge.results[1])
        position_ok, orientation_ok, position_reason, orientation_reason = verdict
        self.since_before = self.since_usable, self.since_position
        if position_ok.any():
            self.since_usable = sample.stamp
        self.since_position = np.where(position_ok, sample.stamp, self.since_position)
        return GatedFrame(
            sample.stamp,
            sample.sequence,
            age,
            self._held(),
            position_ok,
            orientation_ok,
            position_reason,
            orientation_reason,
            bool(position_ok.any() if self.settings.partial == "mask" else position_ok.all()),
        )

    def in_time(self, frame: GatedFrame, now: float) -> bool:
        """Whether the last frame that was looked at may still be used at `now`, s.

        The program may have been held up since: then the frame counts for nothing, as if it had come too late.
        """
        if now - frame.stamp <= self.settings.max_age:
            return True
        self.since_usable, self.since_position = self.since_before
        return False

    def _held(self) -> Array:
        """The last accepted poses (k, 4, 4), m, of the model's frames, in the frame of the samples."""
        T = np.zeros((self.gate.sensors, 4, 4))
        R, p = self._judge.given[0].rotation, self._judge.given[0].position
        T[:, :3, :3], T[:, 3, 3] = R, 1.0
        T[:, :3, 3] = p if self.mounts is None else self.mounts.moved(R, p)
        return np.asarray(self.to_base.T @ T)

    def missing(self, now: float) -> Stop | None:
        """A stop if all bodies, or one, have been missing for too long at `now`, s."""
        without = now - self.since_usable
        if without > self.settings.stale:
            return Stop(StopReason.SENSOR_STALE, f"no usable frame for {without:.3f} s")
        gone = now - self.since_position
        body = int(gone.argmax())
        if gone[body] > self.settings.dropout:
            return Stop(StopReason.SENSOR_DROPOUT, f"body {body + 1} not usable for {gone[body]:.3f} s")
        return None
