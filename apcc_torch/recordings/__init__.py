"""Recordings of real arms: reading, calibration from the rest pose, replay."""

from __future__ import annotations

from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.held_out import held_out_error
from apcc_torch.recordings.recorded_arm import recorded_arm
from apcc_torch.recordings.recording import Recording, save_recording
from apcc_torch.recordings.recording_bag import save_bag
from apcc_torch.recordings.recording_file import detect_layout, load_recording
from apcc_torch.recordings.replay import replay
from apcc_torch.recordings.replay_log import read_replay, replay_metrics, write_replay
from apcc_torch.recordings.rest_pose import calibrate

__all__ = [
    "Recording",
    "RecordingSettings",
    "calibrate",
    "detect_layout",
    "held_out_error",
    "load_recording",
    "read_replay",
    "recorded_arm",
    "replay",
    "replay_metrics",
    "save_bag",
    "save_recording",
    "write_replay",
]
