"""What a calibration measures: the poses of the arm hanging at rest and, if asked, where each tendon pulls it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import SafetyError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.hardware.clock import Clock
from apcc_torch.hardware.interfaces import Array, PoseSensor, TendonActuator
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import Halt
from apcc_torch.lie.rotations import chordal_mean, rotation_angle
from apcc_torch.settings import OURS, Settings, setting

SETTLE, REST = 0.8, 0.5
"""s that the arm gets to follow a pull, and from when on the tip's place counts."""
NO_FRAME = 1.0
"""s more that are waited where no frame came."""
FAR_ENOUGH = 2e-3
"""m that the tip has to move for its way to say anything."""


@dataclass(frozen=True, kw_only=True)
class MeasurementSettings(Settings):
    """How the arm is measured as it hangs at rest."""

    frames: int = setting(50, "", OURS, "complete frames in which the hanging pose is measured", least=1)
    timeout: float = setting(10.0, "s", OURS, "that they may take", above=0)
    scatter: float = setting(2e-3, "m", OURS, "by which a body may move meanwhile", above=0)
    check_signs: bool = setting(
        False, "", OURS, "pull every tendon in a little and see where the arm goes: torque goes on"
    )
    pull: float = setting(5e-3, "m", OURS, "of each tendon", above=0)


def hanging_poses(sensor: PoseSensor, clock: Clock, settings: MeasurementSettings) -> Array:
    """Poses of the bodies in so many complete frames (frames, k, 4, 4), m.

    Raises:
        SafetyError: They did not come in time.
        HardwareError: The source has ended.
    """
    end = clock.now() + settings.timeout
    poses: list[Array] = []
    number: int | None = None
    valid: NDArray[np.bool_] = np.zeros(sensor.n_bodies, dtype=np.bool_)
    while len(poses) < settings.frames:
        left = end - clock.now()
        sample = sensor.wait(left, number) if left > 0 else None
        if sample is None:
            raise SafetyError(
                f"{len(poses)} of {settings.frames} complete frames came in {settings.timeout:g} s; in the last the "
                f"bodies were valid: {valid.tolist()}"
            )
        number, valid = sample.sequence, sample.valid
        if valid.all():
            poses.append(sample.T)
    return np.stack(poses)


def rest_calibration(names: Sequence[str], T: Array, base_rotation: Tensor, scatter: float) -> RestCalibration:
    """Mounts and abscissae from the arm hanging at rest; it counts as straight, along the base's axis.

    Args:
        names: Of the k bodies, from the base to the tip.
        T: (N, k, 4, 4) their poses in the arm's base frame, m.
        base_rotation: (3, 3) the model's base in that frame.
        scatter: Largest distance of a frame from the rest pose, m.

    Raises:
        SafetyError: A body moved, or they are not in order along the arm.
    """
    poses = torch.tensor(T)
    P = torch.tensor(np.median(T[..., :3, 3], axis=0))
    R = torch.stack([chordal_mean(poses[:, k, :3, :3]) for k in range(len(names))])
    far = torch.linalg.vector_norm(poses[..., :3, 3] - P, dim=-1).amax(0)
    if float(far.max()) > scatter:
        name, mm = names[int(far.argmax())], 1e3 * float(far.max())
        raise SafetyError(f"{name} moved by {mm:.1f} mm while the arm was to hang at rest")
    rest = RestCalibration.at_rest(names, torch.zeros(3, dtype=P.dtype), base_rotation.to(P), P, R)
    if not bool((rest.rest_lengths > 0).all()):
        at = rest.abscissae.tolist()
        raise SafetyError(f"the bodies {', '.join(names)} hang at {at} m, not in order along the arm")
    wide = max(float(rotation_angle(R[k], poses[:, k, :3, :3]).max()) for k in range(len(names)))
    return replace(rest, rest_frames=len(T), rest_scatter_m=float(far.max()), rest_scatter_rad=wide)


@dataclass(frozen=True)
class SignCheck:
    """Pulls each tendon in by itself, and looks where the tip goes.

    actuator: Calibrated, without torque. sensor, clock: As in a run. directions: (n_a, 3) unit vectors in the frame of
    the poses to which the tip goes as each tendon is pulled in. limits: Clamps of every command. effort_cap: N, above
    it the check ends. pull: m. period: s between two commands. request: Ends it as well.
    """

    actuator: TendonActuator
    sensor: PoseSensor
    clock: Clock
    directions: Array
    limits: CommandLimits
    effort_cap: float | None
    pull: float
    period: float
    request: StopRequest

    def run(self) -> list[float]:
        """Torque on, one tendon after the other, torque off.

        Returns:
            (n_a,) m by which the tip went the right way.

        Raises:
            SafetyError: It went another way, or nowhere; or a tendon pulled too much.
            HardwareError: A device failed.
            Halt: It was asked to stop.
        """
        self.actuator.arm()
        try:
            zero = self.limits.nearest(self.actuator.read().y)
            return [self._tendon(k, zero) for k in range(self.actuator.n_tendons)]
        finally:
            self.actuator.torque_off()

    def _tendon(self, k: int, zero: Array) -> float:
        pulled = zero.copy()
        pulled[k] -= self.pull
        before = self._go(zero, zero)
        moved = self._go(zero, pulled) - before
        self._go(pulled, zero)
        along = float(moved @ self.directions[k])
        across = float(np.linalg.norm(moved - along * self.directions[k]))
        if along < max(FAR_ENOUGH, across):
            raise SafetyError(
                f"tendon {k + 1}: pulled in by {1e3 * self.pull:g} mm, the tip moved by {1e3 * along:.1f} mm the right "
                f"way and {1e3 * across:.1f} mm across: see its sign, that it is taut, and its place in the order"
            )
        return along

    def _go(self, begin: Array, goal: Array) -> Array:
        """Goes there and stays for a while; returns where the tip then is. The motors are read all along."""
        sent, start = begin, self.clock.now()
        tips: dict[int, Array] = {}
        k = 0
        while (now := self.clock.now()) < start + SETTLE or (not tips and now < start + SETTLE + NO_FRAME):
            k += 1
            self.clock.wait_until(start + k * self.period)
            if self.request.stop is not None:
                raise Halt(self.request.stop)
            effort = self.actuator.read().effort
            if self.effort_cap is not None and not effort.max() <= self.effort_cap:
                raise SafetyError(f"tendon {int(effort.argmax()) + 1} pulled with {effort.max():.0f} N")
            allowed = self.limits.clamp(goal, (sent, self.period))
            sent = self.actuator.send(self.actuator.rounded(*allowed))
            sample = self.sensor.latest()
            if sample is not None and sample.valid[-1] and sample.stamp > start + REST:
                tips[sample.sequence] = sample.T[-1, :3, 3]
        if not tips:
            raise SafetyError(f"the last body was not seen for {SETTLE + NO_FRAME - REST:g} s")
        return np.mean(list(tips.values()), axis=0)
