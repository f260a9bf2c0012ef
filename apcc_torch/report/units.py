"""What a column of a report is called, and the unit of its numbers."""

from __future__ import annotations

from typing import NamedTuple

METRIC_UNITS = {"mm": "mm", "cm": "cm", "m": "m", "s": "s", "rad": "rad", "kg": "kg", "g": "g", "hz": "Hz"} | {
    "n": "N", "nm2": "N m²", "nspm": "N s/m"
}  # fmt: skip
"""The last part of a metric's name -> its unit."""

KEY_UNITS = {
    "adaptation.dead_zone": "m",
    "adaptation.lower": "m",
    "adaptation.rate": "m/s",
    "adaptation.upper": "m",
    "controller.K": "1/s",
    "controller.bend_bound": "rad",
    "controller.bend_rate": "rad/s",
    "controller.elongation_bound": "m",
    "controller.integral_gain": "1/s",
    "controller.integral_reach": "m",
    "controller.length_rate": "m/s",
    "controller.rate": "Hz",
    "dynamics_law.axial_rigidity": "N",
    "dynamics_law.bending_rigidity": "N m²",
    "dynamics_law.filter_time": "s",
    "dynamics_law.force_limit": "N",
    "dynamics_law.mass": "kg",
    "dynamics_law.memory": "s",
    "dynamics_law.payload": "kg",
    "dynamics_law.reference_time": "s",
    "dynamics_law.stiffness": "1/s",
    "dynamics_law.tendon_damping": "N s/m",
    "dynamics_law.torque_noise": "N m",
    "experiment.A": "m",
    "experiment.duration": "s",
    "experiment.omega": "rad/s",
    "experiment.payloads": "kg",
    "experiment.r_0": "m",
    "experiment.setpoints": "m",
    "feedback.angular_threshold": "rad",
    "feedback.linear_threshold": "m",
    "plant.force_limit": "N",
    "plant.lengths": "m",
    "plant.mass": "kg",
    "plant.settle": "s",
    "plant.tendon_damping": "N s/m",
    "pose_filter.angular_time": "s",
    "pose_filter.linear_time": "s",
    "robot.initial_estimate": "m",
    "robot.racks": "m",
    "robot.rest_lengths": "m",
    "robot.sensors": "m",
    "robot.tendon_offset": "m",
    "sensors.angular_noise": "rad",
    "sensors.delay": "samples",
    "sensors.position_noise": "m",
    "velocity_filter.window": "samples",
}
"""Configuration key -> unit, for keys with one."""


class Label(NamedTuple):
    """How a column is headed: words, and a unit, "" without one."""

    words: str
    unit: str


def metric_label(name: str) -> Label:
    """ "shape_error_mean_mm" -> ("shape error mean", "mm")."""
    *parts, last = name.split("_")
    if parts and last in METRIC_UNITS:
        return Label(" ".join(parts), METRIC_UNITS[last])
    return Label(name.replace("_", " "), "")


def key_label(key: str) -> Label:
    """A configuration key as it is, with its unit where it has one."""
    return Label(key, KEY_UNITS.get(key, ""))
