"""How sure a controller's estimate of a step is: the covariance of q_bar, or of the arm's shape and its load."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import ControllerState, Measurement, elapsed
from apcc_torch.estimation.feedback_covariance import feedback_covariance
from apcc_torch.settings import Setting


class SensorNoise(NamedTuple):
    """Standard deviations of the sensors.

    position: Of each coordinate, m. angle: Of each component of the rotation vector, rad.

    Example:
        >>> SensorNoise(position=1e-3, angle=0.01).angle
        0.01
    """

    position: Setting
    angle: Setting


def estimate_covariance(
    controller: APCCController,
    before: ControllerState,
    later: ControllerState,
    measurement: Measurement,
    noise: SensorNoise,
) -> Tensor:
    """The covariance of what a step has estimated.

    Of algorithm 2 it is that of q_bar (..., n, n) under the sensors' noise, see `feedback_covariance`. A controller
    with a `ShapeFeedback` knows its noise, and has that of the strains of the arm's sections, rad and m, and of the
    load at the tip, kg (..., n + 1, n + 1), see `LoadedShape.covariance`.

    Args:
        controller: That made the step.
        before: The state before the step.
        later: The state after it.
        measurement: Of the step.
        noise: Of the sensors, for algorithm 2.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> controller, q, L0 = APCCController.for_arm(arm, adaptive=False), torch.zeros(6).double(), arm.rest_lengths()
        >>> state = controller.initial_state(q, L0, torch.tensor(0.0).double())
        >>> T = controller.backbone.pose(q, L0, *decouple(controller.feedback.abscissae, L0))
        >>> seen, target = Measurement(T, torch.tensor(0.01).double()), Target(T[-1, :3, 3], torch.zeros(3).double())
        >>> later, _ = controller(state, seen, target)
        >>> estimate_covariance(controller, state, later, seen, SensorNoise(1e-3, 0.01)).diagonal().sqrt()
        tensor([0.0094, 0.0094, 0.0010, 0.0140, 0.0140, 0.0014], dtype=torch.float64)
    """
    masks = measurement.mask, measurement.angular_mask
    if controller.shape is None or before.shape is None:
        return feedback_covariance(controller.feedback, later.q_bar, before.pi_hat, noise.position, noise.angle, *masks)
    dt = elapsed(before.time, later.time, controller.integration_limit, later.q_bar)
    T = controller.filtered(before, measurement, dt)[1]
    told = T, *masks, controller.known_lengths(before, measurement), dt, measurement.curvature
    return controller.shape.covariance(controller.feedback, before.shape, before.q_bar, before.pi_hat, *told)
