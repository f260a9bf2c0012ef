"""A recording as a fit takes it: what drove the arm, where its bodies were, and which samples belong together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.recordings.csv_table import read_table
from apcc_torch.recordings.recording import LAYOUTS, Recording, detect_layout, load_recording
from apcc_torch.settings import OURS, Settings, resolved, setting


@dataclass(frozen=True, kw_only=True)
class RecordingSettings(Settings):
    """How a recording is read."""

    inputs: tuple[str, ...] = setting((), "", OURS, "columns of what drives the arm, in any unit")
    bodies: tuple[tuple[str, ...], ...] = setting(
        (), "", OURS, "columns x, y, z of each body, from the base to the tip"
    )
    unit: float = setting(1.0, "m", OURS, "unit of the positions", above=0)
    time: str | None = setting(None, "", OURS, "column of the time in s; null: samples come at `rate`")
    rate: float = setting(100.0, "Hz", OURS, "samples a second, where the recording does not say", above=0)
    group: str | None = setting(None, "", OURS, "column of words that tells movements apart; null: there is none")
    group_ending: str = setting("", "", OURS, "what may end such a word without changing its meaning")
    layout: str = setting(
        "auto",
        "",
        OURS,
        "table: the columns named here; columns or trunk: docs/recordings.md; auto: table where `inputs` names columns",
        choices=("auto", "table", *LAYOUTS),
    )

    def check(self) -> None:
        """Raises ConfigError where a body has not three columns."""
        for columns in self.bodies:
            if not isinstance(columns, list | tuple) or len(columns) != 3:
                raise ConfigError(f"bodies must name three columns a body, got {columns!r}")


@dataclass(frozen=True)
class Series:
    """N samples in the order of time.

    Attributes:
        times: (N,) s, not decreasing.
        inputs: (N, m) what drove the arm, in its own unit.
        positions: (N, k, 3) where the bodies were, m, recording frame.
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


def read_series(path: str | Path, *given: Any, **changes: Any) -> Series:
    """Reads a recording.

    Args:
        path: The file, or a folder that holds it.
        *given, **changes: See `RecordingSettings`.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: The file cannot be read, lacks a column or holds something else than a number, or time goes backward.
    """
    settings = resolved(RecordingSettings, given, changes)
    layout = settings.layout
    if layout == "auto":
        layout = "table" if settings.inputs else detect_layout(path)
    if layout == "table":
        return _read_table(path, settings)
    try:
        return series_of(load_recording(path, layout=layout, rate=settings.rate))
    except DataError as error:
        hint = (
            ""
            if settings.layout != "auto"
            else "; recording.inputs and recording.bodies name the columns of other files"
        )
        raise DataError(f"{error}{hint}") from error


def _read_table(path: str | Path, settings: RecordingSettings) -> Series:
    """Of a CSV file with a header line; columns that are not named are ignored if they hold numbers."""
    for name in ("inputs", "bodies"):
        if not getattr(settings, name):
            raise ConfigError(f"recording.{name} must name columns of {path}")
    group, time = settings.group, settings.time
    file = Path(path)
    table = read_table(file / "recording.csv" if file.is_dir() else file, [] if group is None else [group])
    values = table.finite(settings.inputs)
    positions = torch.stack([table.finite(columns) for columns in settings.bodies], dim=1) * settings.unit
    times = (
        torch.arange(len(values), dtype=values.dtype) / settings.rate if time is None else table.finite([time])[:, 0]
    )
    backward = (times.diff() < 0).nonzero()
    if time is not None and len(backward):
        raise table.fault("the time goes backward", time, int(backward[0]) + 1)
    words = [""] * len(values) if group is None else [w.removesuffix(settings.group_ending) for w in table.words[group]]
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
    turned = None if bool(recording.quaternion.isnan().all()) else recording.rotation[seen]
    return Series(times - times[0], inputs[seen], recording.position[seen], groups, recording.source, turned)
