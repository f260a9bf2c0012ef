"""The setting `residual` to a law of the sensors' residuals, or a bank of models."""

from __future__ import annotations

from torch import Tensor

from apcc_torch.composition.choice import choice
from apcc_torch.composition.schema import ResidualConfig
from apcc_torch.control.length_bank import LengthBank, Shares
from apcc_torch.control.residual_adaptation import TARGETS, ResidualLaw
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.estimation.state_feedback import StateFeedback


def residual_law(
    r: ResidualConfig, feedback: StateFeedback, nominal: Tensor, gains: Tensor | None
) -> ResidualLaw | LengthBank | None:
    """The law that the settings ask for; None without a target.

    Args:
        r: The settings.
        feedback: Algorithm 2 as the controller has it.
        nominal: (..., n_b) pi_hat at the start, m.
        gains: (..., n_b) `r.gains`; a bank has none.

    Raises:
        ConfigError: The target is unknown, or does not fit the sensors.
        ValueRangeError: A setting is out of range.
    """
    if r.target is None:
        return None
    if choice("residual.target", r.target, (*TARGETS, "bank")) == "bank":
        return LengthBank(
            nominal,
            feedback,
            _curve(r, feedback),
            _shares(r.shares, nominal.shape[-1] - 1),
            elongation_weight=r.elongation_weight,
            nominal_weight=r.nominal_weight,
            sharpness=r.sharpness,
            resolution=r.resolution,
            memory=r.memory,
            time_constant=r.time_constant,
            rate=r.rate,
            stretch=r.stretch,
            total_range=r.total_range,
        )
    return ResidualLaw(
        nominal,
        r.target,
        None if r.target == "sensors" else _curve(r, feedback),
        angular_weight=r.angular_weight,
        time_constant=r.time_constant,
        elongation_weight=r.elongation_weight,
        nominal_weight=r.nominal_weight,
        total_weight=r.total_weight,
        damping=r.damping,
        excitation=r.excitation,
        memory=r.memory,
        rate=r.rate,
        gains=gains,
    )


def _shares(shares: Shares | Tensor, sections: int) -> Shares:
    """The shares as a bank takes them; of several runs side by side (P, 1, c), or (P, sections, c) of a list each."""
    if not isinstance(shares, Tensor):
        return shares
    lists = shares.split(1, dim=-2)
    return lists * sections if len(lists) == 1 else lists


def _curve(r: ResidualConfig, feedback: StateFeedback) -> SensorCurve:
    """Through the sensors; with their axes as tangents where algorithm 2 uses them too, if nothing is said."""
    tangents = r.tangents or ("spline" if feedback.mode == "position" else "measured")
    return SensorCurve(feedback.backbone.base_rotation, feedback.abscissae, tangents, r.samples)
