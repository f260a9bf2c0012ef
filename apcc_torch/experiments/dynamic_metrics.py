"""The metrics of dynamic runs."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.simulation.dynamic import DynamicLog

SETTLED = 0.01
"""End-effector error below which a run counts as settled, m."""


def dynamic_metrics(c: RunCurves) -> dict[str, float]:
    """Flat metrics over all runs and instants, SI units in the names."""
    last = c.time >= c.time[-1] - 5.0
    above = (c.e > SETTLED).to(torch.int64)
    # The first instant after the last one above the threshold; the end of the run where it never settles.
    after = (above * torch.arange(1, c.time.shape[0] + 1, device=c.time.device).unsqueeze(-1)).amax(0)
    settling = c.time[after.clamp(max=c.time.shape[0] - 1)]
    metrics = {
        "end_effector_error_end_mm": 1e3 * c.e[-1].mean(),
        "end_effector_error_end_max_mm": 1e3 * c.e[-1].max(),
        "end_effector_error_last5s_max_mm": 1e3 * c.e[last].max(),
        "settled_share": (c.e[-1] <= SETTLED).double().mean(),
        "settling_mean_s": settling.mean(),
        "shape_error_mean_mm": 1e3 * c.shape_error.mean(),
        "shape_error_max_mm": 1e3 * c.shape_error.max(),
        "shape_error_min_mm": 1e3 * c.shape_error.min(),
        "shape_error_end_mm": 1e3 * c.shape_error[-1].mean(),
        "shape_error_end_max_mm": 1e3 * c.shape_error[-1].max(),
        "shape_error_last5s_max_mm": 1e3 * c.shape_error[last].max(),
        "shape_error_last5s_mean_mm": 1e3 * c.shape_error[last].mean(),
        "psi_mean_cm": 1e2 * c.psi.mean(),
        "psi_max_cm": 1e2 * c.psi.max(),
        "psi_min_cm": 1e2 * c.psi.min(),
        "sensor_error_linear_mean_mm": 1e3 * c.linear.mean(),
        "sensor_error_angular_mean_rad": c.angular.mean(),
        "mapping_error_mean_mm": 1e3 * c.mapping_error.mean(),
        "mapping_error_end_mm": 1e3 * c.mapping_error[-1].mean(),
        "pi_drift_end_max_mm": 1e3 * (c.pi_hat[-1] - c.pi_hat[0]).abs().max(),
    }
    for i in range(c.linear.shape[-1]):
        metrics[f"sensor_{i + 1}_error_linear_mean_mm"] = 1e3 * c.linear[..., i].mean()
        metrics[f"sensor_{i + 1}_error_angular_mean_rad"] = c.angular[..., i].mean()
    metrics["rows"] = torch.tensor(float(c.e.shape[1]))
    metrics["diverged_rows"] = (c.diverged[-1] > 0).sum()
    return {name: float(value) for name, value in metrics.items()}


def effort_metrics(log: DynamicLog) -> dict[str, float]:
    """What force the tendons took."""
    values = {"tendon_force_rms_n": log.u.square().mean().sqrt(), "tendon_force_max_n": log.u.abs().max()}
    return {name: float(value) for name, value in values.items()}


def estimate_metrics(log: DynamicLog, theta: Tensor) -> dict[str, float]:
    """What a law of the dynamics has found by the end, beside the true theta (R, 5); nothing where there is none."""
    if log.theta_hat.shape[-1] == 0:
        return {}
    end = dict(zip(PARAMETERS, log.theta_hat[-1].unbind(-1), strict=True))
    off = 1e3 * (end["payload"] - theta[..., PARAMETERS.index("payload")]).abs()
    values = {
        "payload_mass_error_end_mean_g": off.mean(),
        "payload_mass_error_end_max_g": off.max(),
        "bending_rigidity_end_mean_nm2": end["bending_rigidity"].mean(),
        "axial_rigidity_end_mean_n": end["axial_rigidity"].mean(),
        "tendon_damping_end_mean_nspm": end["tendon_damping"].mean(),
    }
    return {name: float(value) for name, value in values.items()}
