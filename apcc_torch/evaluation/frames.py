"""Moments of a recording as a method sees them: what drove the arm, and where the bodies were that it is shown."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.series import Series
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.recordings.recorded_arm import gate_frames


class Past(NamedTuple):
    """The two samples before N moments, the newest first; NaN where one was not seen or was of another movement.

    positions: (N, 2, k, 3) m, recording frame. drive: What drove the arm at the sample before.
    """

    positions: Tensor
    drive: Drive

    @staticmethod
    def of(series: Series, drive: Drive) -> Past:
        """Of every sample of a recording and what drove it."""
        index = torch.arange(len(series))
        before = (index.unsqueeze(-1) - torch.tensor([1, 2])).clamp(min=0)
        same = (series.groups[before] == series.groups.unsqueeze(-1)) & (before < index.unsqueeze(-1))
        same[:2, 1] = False
        return Past(torch.where(same[..., None, None], series.positions[before], torch.nan), drive.rows(before[:, 0]))

    @property
    def seen(self) -> Tensor:
        """Indices of the moments before which every body was seen twice."""
        return self.positions.isfinite().flatten(1).all(-1).nonzero().squeeze(-1)


@dataclass(frozen=True)
class Frames:
    """N moments in the order of time; NaN where something is not shown.

    times: (N,) s. drive: What drove the arm, with its past. positions: (N, k, 3) m, recording frame.
    rotations: (N, k, 3, 3) body axes as columns, recording frame. groups: (N,) int64 number of the movement.
    past: Of these moments.
    """

    times: Tensor
    drive: Drive
    positions: Tensor
    rotations: Tensor
    groups: Tensor
    past: Past

    @staticmethod
    def of(series: Series, history: int = 1, travel: float = 0.0) -> Frames:
        """Every sample of a recording; see `Series.drive`."""
        rotations = series.rotations
        if rotations is None:
            rotations = series.positions.new_full((*series.positions.shape, 3), torch.nan)
        drive = series.drive(history, travel)
        past = Past.of(series, drive)
        return Frames(series.times, drive, series.positions, rotations, series.groups, past)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def inputs(self) -> Tensor:
        """What drives the arm now (N, m)."""
        return self.drive.history[:, 0]

    def at(self, index: Tensor) -> Frames:
        """Some of the moments."""
        past = Past(self.past.positions[index], self.past.drive.rows(index))
        return Frames(
            self.times[index],
            self.drive.rows(index),
            self.positions[index],
            self.rotations[index],
            self.groups[index],
            past,
        )

    def showing(self, task: Task) -> Frames:
        """The same moments, of which only that is seen which the task shows."""
        bodies = list(task.shown)
        positions, rotations = torch.full_like(self.positions, torch.nan), torch.full_like(self.rotations, torch.nan)
        positions[:, bodies] = self.positions[:, bodies]
        if task.orientations:
            rotations[:, bodies] = self.rotations[:, bodies]
        drive, past = self.drive, self.past
        if not task.motors:
            drive = unseen(drive)
        if not task.ahead:
            past = Past(torch.full_like(past.positions, torch.nan), unseen(past.drive))
        return replace(self, drive=drive, positions=positions, rotations=rotations, past=past)

    def gated(self, calibration: RestCalibration) -> Frames:
        """The same without the orientations that no arm can have had, such as those of swapped markers."""
        if bool(self.rotations.isnan().all()):
            return self
        T = calibration.poses(self.positions, self.rotations)
        tracked = torch.ones(T.shape[:2], dtype=torch.bool)
        _, verdict = gate_frames(SensorGate(calibration.abscissae), T, tracked, self.times)
        right = verdict.orientation_ok[..., None, None]
        return replace(self, rotations=torch.where(right, self.rotations, torch.nan))


def unseen(drive: Drive) -> Drive:
    """As much of what drives an arm, all NaN."""
    return Drive(*(torch.full_like(value, torch.nan) for value in drive))
