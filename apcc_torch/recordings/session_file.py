"""A session of a data set: its recording, with what drove the arm where another file says it, and its rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.column_names import clock, drives
from apcc_torch.recordings.csv_table import sheet_of, text_of
from apcc_torch.recordings.data_set import STILL, DataSettings, SessionSettings
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.rest_pose import still_frame_count


def load_session(
    folder: Path, session: SessionSettings, settings: RecordingSettings, arm: Arm | None = None
) -> Recording:
    """The recording of a session.

    Args:
        folder: Of its files.
        session: Which one.
        settings: How it is read.
        arm: See `load_recording`.

    Raises:
        ConfigError, DataError: As `load_recording`.
    """
    if not session.inputs:
        return load_recording(folder / session.file, settings, arm=arm)
    recording = load_recording(folder / session.file, settings.changed(inputs=()), arm=arm)
    stamps, values = _driven(folder / session.inputs, settings, recording)
    at = torch.searchsorted(stamps, recording.times, right=True) - 1
    if not bool((at >= 0).any()):
        raise DataError(f"{folder / session.inputs}: begins after {recording.source} ends; both must have one clock")
    known = at >= 0
    return replace(frames_of(recording, known), inputs=values[at[known]], actuators=None)


def frames_of(recording: Recording, index: Tensor) -> Recording:
    """Some frames of a recording: their indices, or a mask (T,)."""
    names = ("times", "position", "quaternion", "tracked", "inputs", "actuators", "target", "groups")
    values = {name: getattr(recording, name) for name in names}
    return replace(recording, **{name: value[index] for name, value in values.items() if value is not None})


def _driven(path: Path, settings: RecordingSettings, recording: Recording) -> tuple[Tensor, Tensor]:
    """Stamps (N,), s, and inputs (N, m) of a file that holds nothing else; without a time they are the frames'."""
    sheet = sheet_of(path, text_of(path), settings.delimiter, settings.decimal, settings.comment)
    sent, measured = drives(sheet.names, settings)
    names, time = measured or sent, clock(sheet.names, settings.changed(time=None))
    if not names:
        raise DataError(f"{path}: has no columns u1, ... or phi1, ...; recording.inputs names others")
    table = sheet.table([*names, *(name for name, _ in time)])
    values = table.finite(names)
    if not time:
        if len(values) != len(recording):
            raise DataError(f"{path}: has no time, and {len(values)} lines for {len(recording)} frames")
        return recording.times, values
    stamps = (table.finite([name for name, _ in time]) * values.new_tensor([unit for _, unit in time])).sum(-1)
    backward = (stamps.diff() < 0).nonzero()
    if len(backward):
        raise table.fault("the time goes backward", time[0][0], int(backward[0]) + 1)
    return stamps, values


def load_rest(
    folder: Path, data: DataSettings, settings: RecordingSettings, arm: Arm | None = None
) -> Recording | None:
    """The frames in which the arm of a data set rests, straight; None where it names none.

    Raises:
        ConfigError, DataError: As `load_recording`; or nothing says where the rest ends.
    """
    if data.rest is None:
        return None
    if data.rest == STILL:
        recording = load_session(folder, data.sessions[data.learned], settings, arm)
        count = still_frame_count(recording)
    else:
        recording = load_recording(folder / data.rest, settings, arm=arm)
        count = len(recording)
    if data.rest_frames is not None:
        count = min(data.rest_frames, len(recording))
    return frames_of(recording, torch.arange(count))
