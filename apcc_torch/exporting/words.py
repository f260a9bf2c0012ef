"""What members of a library's structs are: unit and meaning, by the tuple that they come from and their name there."""

from __future__ import annotations

from typing import NamedTuple


class Words(NamedTuple):
    """unit: "" for none. meaning: In a few words."""

    unit: str
    meaning: str


_STATUS = "see enum {prefix}_status"
_Q = "a section after the other: its bends rad, rad and its elongation m"

STRUCTS: dict[str, str] = {
    "state": "What the controller remembers between two steps. Copy it, store it, but do not change it.",
    "measurement": "One reading of the sensors.",
    "target": "Where the end effector should be.",
    "command": "What the controller asks for, and what it saw.",
    "uncertainty": "How sure the estimate of a step is.",
    "beginning": "Where a controller begins.",
    "loop": "What the loop on the tendons' lengths remembers. All zero at first.",
    "tendons": "What the loop on the tendons' lengths needs to know.",
    "forces": "What the loop on the tendons' lengths asks for.",
    "plant": "The true arm.",
    "reference": "Where its motors go in a step.",
    "view": "What is seen of it.",
}
"""Of the structs themselves."""

MEMBERS: dict[str, Words] = {
    "ControllerState.q_bar": Words("rad, m", f"configuration as last inferred, {_Q}"),
    "ControllerState.qdot_bar": Words("rad/s, m/s", "its filtered velocity"),
    "ControllerState.pi_hat": Words("m", "estimates of the rest lengths"),
    "ControllerState.q_d": Words("rad, m", "desired configuration"),
    "ControllerState.qdot": Words("rad/s, m/s", "last commanded velocity"),
    "ControllerState.time": Words("s", "stamp of the last measurement"),
    "ControllerState.integral": Words("m", "integral of the position error, in the world"),
    "SavitzkyGolayState.samples": Words("rad, m", "last configurations, the oldest first"),
    "SavitzkyGolayState.times": Words("s", "their stamps"),
    "SavitzkyGolayState.valid": Words("", "which of them count"),
    "PoseFilterState.T": Words("m", "where the sensors are expected, homogeneous, row by row"),
    "PoseFilterState.age": Words("s", "since orientation and position were last read"),
    "PoseFilterState.since": Words("m", "motions commanded since, the oldest first"),
    "FollowedShape.lengths": Words("m", "of the model's sections, rest length and elongation"),
    "FollowedShape.tip": Words("m", "where the tip was, behind a low-pass"),
    "ShapeState.sections": Words("rad, m", "bends rad, rad and length m of the arm's sections"),
    "ShapeState.load": Words("kg", "at the tip"),
    "ShapeState.deviation": Words("rad, m, kg", "standard deviations of the sections' strains and of the load"),
    "ShapeState.sag": Words("rad, m", "of the arm's pieces, by its own weight and by each kg at the tip"),
    "ShapeState.misfit": Words("", "of the sensor that is farthest off, in standard deviations, squared"),
    "ShapeState.age": Words("s", "since it began"),
    "PressureState.z": Words("N", "integral of the chambers' loop"),
    "PressureState.y": Words("m", "last length changes of the chambers"),
    "PressureState.ydot": Words("m/s", "their rates, filtered"),
    "PressureState.excess": Words("rad, m", "strains that the chambers cannot make"),
    "CompositeState.rate": Words("rad/s, m/s", "filtered rate of q_d"),
    "DynamicsEstimate.theta_hat": Words("N m^2, N, N s/m, kg, kg", "rigidities, tendon damping, payload, mass"),
    "DynamicsEstimate.information": Words("", "of them, in units of their deviations"),
    "DynamicsEstimate.regressor": Words("N m, N", "filtered, per unit of each of them"),
    "DynamicsEstimate.tau": Words("N m, N", "filtered forces of the tendons"),
    "Measurement.T": Words("m", "poses of the sensors in the world, homogeneous, row by row, from the base to the tip"),
    "Measurement.time": Words("s", "stamp; must not go back"),
    "Measurement.mask": Words("", "which sensors count"),
    "Measurement.angular_mask": Words("", "of which of them the orientation counts"),
    "Measurement.forces": Words("N", "of the tendons, tension is -force; NAN: not measured"),
    "Measurement.tendons": Words("m", "length changes of the tendons; NAN: not known"),
    "Target.x_d": Words("m", "desired position in the world"),
    "Target.xdot_d": Words("m/s", "desired velocity"),
    "Answer.y": Words("m", "wanted length changes of the tendons or chambers"),
    "Answer.q_d": Words("rad, m", f"desired configuration, {_Q}"),
    "Answer.qdot": Words("rad/s, m/s", "commanded velocity"),
    "Answer.force": Words("N", "feed-forward of the loop on the tendons' lengths"),
    "Answer.pressure": Words("Pa", "of the chambers, gauge"),
    "Answer.e": Words("m", "position error, target less end effector"),
    "Answer.limits": Words("", "see enum {prefix}_limits"),
    "Answer.q_bar": Words("rad, m", "estimated configuration"),
    "Answer.pi_hat": Words("m", "rest lengths after this step"),
    "Answer.status": Words("", _STATUS),
    "Answer.iterations": Words("", "of the estimator"),
    "Answer.angular_error": Words("rad", "by which the model's sensors are off; 0 where masked"),
    "Answer.linear_error": Words("m", "likewise"),
    "Answer.load": Words("kg", "estimated at the tip"),
    "Uncertainty.covariance": Words("rad, m", "of q_bar, for independent noise of the sensors"),
    "ShapeUncertainty.covariance": Words("rad, m, kg", "of the strains of the sections and the load, which is last"),
    "Beginning.q": Words("rad, m", f"first guess of the configuration, {_Q}; zero: straight"),
    "Beginning.pi_hat": Words("m", "first estimates of the rest lengths, as {prefix}_first_estimate"),
    "Beginning.time": Words("s", "at or before the first measurement"),
    "TendonMemory.z": Words("m s", "integral of the error"),
    "TendonInput.y": Words("m", "measured length changes"),
    "TendonInput.ydot": Words("m/s", "their rates"),
    "TendonInput.y_d": Words("m", "wanted length changes, y of the command"),
    "TendonInput.ydot_d": Words("m/s", "their rates"),
    "TendonInput.force": Words("N", "feed-forward, force of the command"),
    "TendonInput.dt": Words("s", "period of the loop"),
    "TendonForces.u": Words("N", "on the tendons; tension is -u"),
    "ArmState.q": Words("rad, m", f"configuration of the arm's pieces, {_Q}"),
    "ArmState.qdot": Words("rad/s, m/s", "its velocity"),
    "PlantState.z": Words("m s", "integral of the tendon loop"),
    "PlantState.diverged_at": Words("", "-1 while the arm is well, 0 once it has diverged"),
    "PlantState.time": Words("s", "since the arm was at rest"),
    "PlantState.held": Words("m, Pa", "to where the motors have drawn the tendons; pressures of chambers"),
    "TendonReference.y_d": Words("m", "length changes at the step's end"),
    "TendonReference.ydot_d": Words("m/s", "their rates during the step"),
    "TendonReference.force": Words("N", "feed-forward"),
    "TendonReference.pressure": Words("Pa", "what the chambers' valves are told"),
    "PlantView.T": Words("m", "true poses of the sensors, homogeneous, row by row"),
    "PlantView.y": Words("m", "length changes of the tendons or chambers"),
}
"""By CLASS.FIELD. What a law of one's own remembers is not here, and has no words."""
