"""Moments of a recording as a method sees them: what drove the arm, and where the bodies were that it is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.identification.series import Series
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.recordings.recorded_arm import gate_frames


@dataclass(frozen=True)
class Frames:
    """N moments in the order of time; NaN where something is not shown.

    times: (N,) s. drive: What drove the arm, with its past. positions: (N, k, 3) m, recording frame.
    rotations: (N, k, 3, 3) body axes as columns, recording frame. groups: (N,) int64 number of the movement.
    """

    times: Tensor
    drive: Drive
    positions: Tensor
    rotations: Tensor
    groups: Tensor

    @staticmethod
    def of(series: Series, history: int = 1, travel: float = 0.0) -> Frames:
        """Every sample of a recording; see `Series.drive`."""
        rotations = series.rotations
        if rotations is None:
            rotations = series.positions.new_full((*series.positions.shape, 3), torch.nan)
        return Frames(series.times, series.drive(history, travel), series.positions, rotations, series.groups)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def inputs(self) -> Tensor:
        """What drives the arm now (N, m)."""
        return self.drive.history[:, 0]

    def at(self, index: Tensor) -> Frames:
        """Some of the moments."""
        return Frames(
            self.times[index], self.drive.rows(index), self.positions[index], self.rotations[index], self.groups[index]
        )

    def showing(self, bodies: Sequence[int], motors: bool, orientations: bool) -> Frames:
        """The same moments, of which only these bodies are seen, and the motors or the orientations if so."""
        positions, rotations = torch.full_like(self.positions, torch.nan), torch.full_like(self.rotations, torch.nan)
        positions[:, bodies] = self.positions[:, bodies]
        if orientations:
            rotations[:, bodies] = self.rotations[:, bodies]
        drive = self.drive
        if not motors:
            drive = Drive(*(torch.full_like(value, torch.nan) for value in drive))
        return replace(self, drive=drive, positions=positions, rotations=rotations)

    def gated(self, calibration: RestCalibration) -> Frames:
        """The same without the orientations that no arm can have had, such as those of swapped markers."""
        if bool(self.rotations.isnan().all()):
            return self
        T = calibration.poses(self.positions, self.rotations)
        tracked = torch.ones(T.shape[:2], dtype=torch.bool)
        _, verdict = gate_frames(SensorGate(calibration.abscissae), T, tracked, self.times)
        right = verdict.orientation_ok[..., None, None]
        return replace(self, rotations=torch.where(right, self.rotations, torch.nan))
