"""Between the pose sensor and the controller: which frames are new, in time and moving, and which bodies to believe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.hardware.interfaces import Array, PoseSample
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.stops import Stop, StopReason
from apcc_torch.settings import check_setting

PARTIAL = ("skip", "mask")


@dataclass(frozen=True)
class SensingLimits:
    """Limits of the frames' times.

    max_age: s, an older frame is not used.
    stale: s without an accepted position of any body before the run stops.
    dropout: s without an accepted position of one body before the run stops.
    frozen_frames: So many frames in a row with the very same poses count as a frozen source, and are not used; None:
        never.
    partial: What happens to a frame that lacks a body: "skip", the last wish stands until a whole frame comes, or
        "mask", the controller steps on the bodies that are there. Where pi_hat has moved a section's end past a
        sensor, what is left says next to nothing of one section, and a masked step can be far off.

    Raises:
        ValueRangeError: A limit is not positive.
    """

    max_age: float = 0.06
    stale: float = 0.2
    dropout: float = 0.3
    frozen_frames: int | None = 10
    partial: str = "skip"

    def __post_init__(self) -> None:
        """Checks the limits."""
        for name in ("max_age", "stale", "dropout"):
            check_setting(f"sensing.{name}", getattr(self, name))
        if self.frozen_frames is not None and self.frozen_frames < 2:
            raise ValueRangeError(f"sensing.frozen_frames must be at least 2, got {self.frozen_frames}")
        if self.partial not in PARTIAL:
            raise ValueRangeError(f"sensing.partial must be one of {', '.join(PARTIAL)}, got {self.partial!r}")


@dataclass(frozen=True)
class Seen:
    """A new frame after the gate.

    stamp: s, when it was measured. sequence: The source's number. age: s, when it was looked at.
    T: (k, 4, 4) poses, finite always: a body's last accepted pose where this frame's was not accepted.
    position_ok, orientation_ok: (k,) what to believe. position_reason, orientation_reason: (k,) `gating.Reason`.
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


class Sensing:
    """Judges every frame once, and remembers since when what has been missing.

    Args:
        gate: Judges bodies.
        base_rotation: (3, 3) orientation of the arm's base in the frame of the poses; the gate judges in the base.
        limits: Limits of the frames' times.
        mounts: How the bodies sit on the arm; None where the source's poses are the model's frames already.
    """

    def __init__(
        self, gate: SensorGate, base_rotation: Tensor, limits: SensingLimits, mounts: Mounts | None = None
    ) -> None:
        self.gate = gate
        self.limits = limits
        self.mounts = mounts
        # NumPy around the gate: on so few numbers a tensor's every operation costs more than the numbers.
        self.to_base = np.eye(4)
        self.to_base[:3, :3] = base_rotation.detach().double().numpy().T
        like = torch.zeros(gate.sensors, 4, 4, dtype=torch.float64)
        self.state = gate.initial_state(like, torch.zeros((), dtype=torch.float64))
        self.last: PoseSample | None = None
        self.repeats = 0
        self.since_usable = 0.0
        self.since_position = np.zeros(gate.sensors)

    def begin(self, now: float) -> None:
        """What is missing is counted from now, s."""
        self.since_usable = now
        self.since_position = np.full(self.gate.sensors, now)

    def look(self, sample: PoseSample | None, now: float) -> Seen | None:
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
        frozen = self.limits.frozen_frames is not None and self.repeats + 1 >= self.limits.frozen_frames
        forward = last is None or sample.stamp > last.stamp
        # A stamp from the future is as wrong as one from long ago.
        timely = forward and not frozen and -self.limits.max_age <= age <= self.limits.max_age
        poses = sample.T if self.mounts is None else self.mounts.turned(sample.T)
        # Copies: a source's arrays may be read-only, which tensors cannot be.
        tracked = torch.tensor(sample.valid & timely)
        T = torch.tensor(self.to_base @ poses)
        stamp = torch.tensor(sample.stamp, dtype=torch.float64)
        self.state, verdict = self.gate(self.state, T, tracked, stamp)
        position_ok = verdict.position_ok.numpy()
        if position_ok.any():
            self.since_usable = sample.stamp
        self.since_position = np.where(position_ok, sample.stamp, self.since_position)
        return Seen(
            sample.stamp,
            sample.sequence,
            age,
            self._held(),
            position_ok,
            verdict.orientation_ok.numpy(),
            verdict.position_reason.numpy(),
            verdict.orientation_reason.numpy(),
            bool(position_ok.any() if self.limits.partial == "mask" else position_ok.all()),
        )

    def _held(self) -> Array:
        """The last accepted poses (k, 4, 4), m, of the model's frames, in the frame of the samples."""
        T = np.zeros((self.gate.sensors, 4, 4))
        R, p = self.state.rotation.numpy(), self.state.position.numpy()
        T[:, :3, :3], T[:, 3, 3] = R, 1.0
        T[:, :3, 3] = p if self.mounts is None else self.mounts.moved(R, p)
        return np.asarray(self.to_base.T @ T)

    def missing(self, now: float) -> Stop | None:
        """A stop if all bodies, or one, have been missing for too long at `now`, s."""
        without = now - self.since_usable
        if without > self.limits.stale:
            return Stop(StopReason.SENSOR_STALE, f"no usable frame for {without:.3f} s")
        gone = now - self.since_position
        body = int(gone.argmax())
        if gone[body] > self.limits.dropout:
            return Stop(StopReason.SENSOR_DROPOUT, f"body {body + 1} not usable for {gone[body]:.3f} s")
        return None
