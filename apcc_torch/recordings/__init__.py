"""Recordings of real arms: reading, calibration from the rest pose, replay."""
