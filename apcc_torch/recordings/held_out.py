"""An independent check of a replay: each sensor against a fit that never sees it."""

from __future__ import annotations

import torch

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.replay import replay
from apcc_torch.recordings.replay_log import SensorErrors, sensor_errors
from apcc_torch.simulation.progress import Progress, quiet


def held_out_error(
    recording: Recording,
    calibration: RestCalibration,
    feedback: StateFeedback,
    gate: SensorGate,
    frames: slice = slice(None),
    progress: Progress = quiet,
) -> SensorErrors:
    """How well a sensor is predicted by a fit that never sees it: an independent check of the model's shape.

    For each sensor but the last, the arm is modelled as it would be without it, one section ending at each sensor
    that is left, and fitted to those in the estimator's mode; the sensor then lies inside a section. (The model with
    a section for every sensor leaves open where a sensor that is not shown lies.) Beyond the last one that is shown
    the arm is not known.

    Args:
        recording, calibration, feedback, gate, frames, progress: As `replay`; of `feedback` the settings are taken.

    Returns:
        linear and angular (N, k - 1): column i from the fit without sensor i, NaN where the gate did not accept it.

    Raises:
        ValueRangeError: There is a single sensor.
        ApccError: As `replay`.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> errors = held_out_error(still, arm.calibration, arm.feedback, arm.gate)
        >>> bool(errors.linear.nanmean() < 1e-4)
        True
    """
    X = calibration.abscissae
    k = len(X)
    if k < 2:
        raise ValueRangeError("feedback must have two sensors or more for one to be left out")
    shown = ~torch.eye(k, dtype=torch.bool)[: k - 1]
    pi_hat = torch.stack([torch.diff(X[row], prepend=X.new_zeros(1)) for row in shown])
    fewer = StateFeedback(feedback.backbone.resized(k - 1).cpu(), X, feedback.settings)
    log = replay(
        recording, calibration, fewer, gate, pi_hat, mask=shown, frames=frames, parallel=True, progress=progress
    )
    errors = sensor_errors(log, fewer)
    return SensorErrors(*(part.diagonal(dim1=-2, dim2=-1) for part in errors))
