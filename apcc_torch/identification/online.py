"""A model that learns as it goes: every sample is predicted first, then used to correct the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.identification.fit import sensitivity
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.settings import OURS, Settings, resolved, setting


@dataclass(frozen=True, kw_only=True)
class OnlineSettings(Settings):
    """How parameters are adapted from sample to sample."""

    noise: float = setting(0.01, "m", OURS, "deviation of a coordinate that the model cannot explain", above=0)
    walk: float = setting(0.03, "", OURS, "by how much of its spread each parameter wanders a sample", least=0)


def adapt(
    arm: TendonArm, parameters: Parameters, drive: Drive, positions: Tensor, *given: Any, **changes: Any
) -> tuple[Tensor, Tensor]:
    """An extended Kalman filter over the parameters' standard scores, from the nominal values on.

    Args:
        arm: The model.
        parameters: What to adapt.
        drive: At N moments, in the order of time.
        positions: (N, k, 3) measured, m.
        *given, **changes: See `OnlineSettings`.

    Returns:
        Predictions (N, k, 3) m, each made before its sample was used, and the scores (N, P) after it.
    """
    settings = resolved(OnlineSettings, given, changes)
    noise, walk = settings.noise, settings.walk
    z = parameters.nominal()
    eye = torch.eye(len(z), dtype=z.dtype)
    covariance = eye
    predictions, scores = [], []
    for n in range(len(positions)):
        now = drive.rows(slice(n, n + 1))
        values = parameters.values(z)
        q = arm.rest(now, values)
        J, prediction = sensitivity(arm, parameters, now, z, q).flatten(0, -2), arm.bodies(q, values).flatten()
        predictions.append(prediction)
        innovation = J @ covariance @ J.mT + noise * noise * torch.eye(len(J), dtype=z.dtype)
        gain = torch.linalg.solve(innovation, J @ covariance).mT
        z = z + gain @ (positions[n].flatten() - prediction)
        shrunk = eye - gain @ J
        # Joseph's form stays symmetric and positive.
        covariance = shrunk @ covariance @ shrunk.mT + noise * noise * gain @ gain.mT + walk * walk * eye
        scores.append(z)
    return torch.stack(predictions).reshape(positions.shape), torch.stack(scores)
