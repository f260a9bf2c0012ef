"""A recording as a fit takes it: what drove the arm, where its bodies were, and which samples belong together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_file import load_recording


@dataclass(frozen=True)
class Series:
    """N samples in the order of time.

    Attributes:
        times: (N,) s, not decreasing.
        inputs: (N, m) what drove the arm, in its own unit.
        positions: (N, k, 3) where the bodies were, m, recording frame; NaN where one was not tracked.
        groups: (N,) int64, the same number for samples of one movement; zeros where nothing is known of movements.
        source: The file.
        rotations: (N, k, 3, 3) the bodies' axes in the recording frame, as columns; None where positions alone are
            known.
    """

    times: Tensor
    inputs: Tensor
    positions: Tensor
    groups: Tensor
    source: str = ""
    rotations: Tensor | None = None

    def __len__(self) -> int:
        return len(self.times)

    @property
    def seen(self) -> Tensor:
        """Whether every body was tracked (N,)."""
        return self.positions.isfinite().flatten(1).all(-1)

    def slides(self, travel: float) -> Tensor:
        """Direction in which each input last moved (N, m), from -1 to 1; it turns over within `travel` of the input."""
        if travel <= 0.0:
            return torch.zeros_like(self.inputs)
        state, states = torch.zeros_like(self.inputs[0]), []
        for change in self.inputs.diff(dim=0, prepend=self.inputs[:1]):
            state = (state + 2.0 * change / travel).clamp(-1.0, 1.0)
            states.append(state)
        return torch.stack(states)

    def drive(self, history: int = 1, travel: float = 0.0) -> Drive:
        """What drives the arm at every sample.

        Args:
            history: Inputs that matter, the present one included; those before the first count as the first.
            travel: Of the input, over which a tendon's sliding turns over; zero: friction is not modelled.
        """
        index = torch.arange(len(self)).unsqueeze(-1) - torch.arange(history)
        index = index.clamp(min=0)
        return Drive(self.inputs[index], self.times.unsqueeze(-1) - self.times[index], self.slides(travel))


def read_series(path: str | Path, *given: Any, arm: Arm | None = None, **changes: Any) -> Series:
    """Reads a recording.

    Args:
        path: The file, or a folder that holds it.
        *given, **changes: See `RecordingSettings`.
        arm: See `load_recording`.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: The file cannot be read, lacks a column or holds something else than a number, or time goes backward.
    """
    return series_of(load_recording(path, *given, arm=arm, **changes))


def series_of(recording: Recording) -> Series:
    """The frames of a motion-capture recording; inputs are what the actuators measured, else what they were sent.

    Raises:
        DataError: It has no inputs, or no frame with every body.
    """
    inputs = recording.inputs if recording.actuators is None else recording.actuators
    if inputs is None:
        raise DataError(
            f"{recording.source}: has neither columns phi1, ... nor u1, ... that say what drove the arm; "
            "recording.inputs names others"
        )
    positions = torch.where(recording.tracked.unsqueeze(-1), recording.position, torch.nan)
    times = recording.times - recording.times[0]
    groups = torch.zeros(len(times), dtype=torch.int64) if recording.groups is None else recording.groups
    turned = None
    if not bool(recording.quaternion.isnan().all()):
        turned = torch.where(recording.tracked[..., None, None], recording.rotation, torch.nan)
    series = Series(times, inputs, positions, groups, recording.source, turned)
    if not bool(series.seen.any()):
        raise DataError(f"{recording.source}: has no frame in which every body was tracked")
    return series


def joined(first: Series, then: Series) -> Series:
    """Two recordings one after the other, which share neither a moment nor a movement.

    Raises:
        DataError: They have other inputs or bodies.
    """
    for name in ("inputs", "positions"):
        a, b = (getattr(each, name).shape[1] for each in (first, then))
        if a != b:
            raise DataError(f"{then.source}: has {b} {name}, {first.source} has {a}")
    apart = 1.0 + float(first.times[-1])
    rotations = None
    if first.rotations is not None and then.rotations is not None:
        rotations = torch.cat((first.rotations, then.rotations))
    return Series(
        torch.cat((first.times, apart + then.times)),
        torch.cat((first.inputs, then.inputs)),
        torch.cat((first.positions, then.positions)),
        torch.cat((first.groups, 1 + first.groups.max() + then.groups)),
        first.source,
        rotations,
    )
