"""A recording as a fit takes it: what drove the arm, where its bodies were, and which samples belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.recordings.csv_table import read_table
from apcc_torch.recordings.recording import Recording


@dataclass(frozen=True)
class Series:
    """N samples in the order of time.

    Attributes:
        times: (N,) s, not decreasing.
        inputs: (N, m) what drove the arm, in its own unit.
        positions: (N, k, 3) where the bodies were, m, recording frame.
        groups: (N,) int64, the same number for samples of one movement; zeros where nothing is known of movements.
        source: The file.
    """

    times: Tensor
    inputs: Tensor
    positions: Tensor
    groups: Tensor
    source: str = ""

    def __len__(self) -> int:
        return len(self.times)

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


def read_series(
    path: str | Path,
    inputs: Sequence[str],
    bodies: Sequence[Sequence[str]],
    unit: float = 1.0,
    time: str | None = None,
    rate: float = 100.0,
    group: str | None = None,
    group_ending: str = "",
) -> Series:
    """Reads a CSV file with a header line; columns that are not named are ignored if they hold numbers.

    Args:
        path: The file, or a folder that holds it as recording.csv.
        inputs: Columns of the inputs.
        bodies: Three columns, x, y and z, for every body, from the base to the tip.
        unit: Of the positions, m.
        time: Column of the time, s; None: samples come at `rate`.
        rate: Hz.
        group: Column of words that tells movements apart; None: there is none.
        group_ending: What may end a word without changing its meaning.

    Raises:
        ConfigError: A body has not three columns.
        DataError: The file cannot be read, lacks a column or holds something else than a number, or time goes backward.
    """
    for columns in bodies:
        if len(columns) != 3:
            raise ConfigError(f"recording.bodies must name three columns a body, got {list(columns)}")
    file = Path(path)
    table = read_table(file / "recording.csv" if file.is_dir() else file, [] if group is None else [group])
    values = table.finite(inputs)
    positions = torch.stack([table.finite(columns) for columns in bodies], dim=1) * unit
    times = torch.arange(len(values), dtype=values.dtype) / rate if time is None else table.finite([time])[:, 0]
    backward = (times.diff() < 0).nonzero()
    if time is not None and len(backward):
        raise table.fault("the time goes backward", time, int(backward[0]) + 1)
    words = [""] * len(values) if group is None else [w.removesuffix(group_ending) for w in table.words[group]]
    numbers = {word: i for i, word in enumerate(dict.fromkeys(words))}
    groups = torch.tensor([numbers[word] for word in words])
    return Series(times - times[0], values, positions, groups, str(path))


def series_of(recording: Recording) -> Series:
    """The frames of a motion-capture recording in which every body was tracked; inputs are what the actuators measured.

    Raises:
        DataError: It has no inputs, or no frame with every body.
    """
    inputs = recording.inputs if recording.actuators is None else recording.actuators
    if inputs is None:
        raise DataError(f"{recording.source}: has neither columns phi1, ... nor u1, ... that say what drove the arm")
    seen = recording.tracked.all(-1) & recording.position.isfinite().flatten(1).all(-1)
    if not bool(seen.any()):
        raise DataError(f"{recording.source}: has no frame in which every body was tracked")
    groups = torch.zeros(int(seen.sum()), dtype=torch.int64)
    times = recording.times[seen]
    return Series(times - times[0], inputs[seen], recording.position[seen], groups, recording.source)
