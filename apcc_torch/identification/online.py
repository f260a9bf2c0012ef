"""A model that learns as it goes: every sample is predicted first, then used to correct the parameters."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import jacfwd

from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm


def adapt(
    arm: TendonArm, parameters: Parameters, drive: Drive, positions: Tensor, noise: float, walk: float
) -> tuple[Tensor, Tensor]:
    """An extended Kalman filter over the parameters' standard scores, from the nominal values on.

    Args:
        arm: The model.
        parameters: What to adapt.
        drive: At N moments, in the order of time.
        positions: (N, k, 3) measured, m.
        noise: Standard deviation of a coordinate that the model cannot explain, m.
        walk: Standard deviation by which every score wanders from sample to sample.

    Returns:
        Predictions (N, k, 3) m, each made before its sample was used, and the scores (N, P) after it.
    """
    z = parameters.nominal()
    eye = torch.eye(len(z), dtype=z.dtype)
    covariance = eye
    predictions, scores = [], []
    for n in range(len(positions)):
        now = drive.rows(slice(n, n + 1))
        q = arm.rest(now, parameters.values(z))

        def predicted(at: Tensor, now: Drive = now, q: Tensor = q) -> tuple[Tensor, Tensor]:
            there = arm.positions(now, parameters.values(at), q).flatten()
            return there, there

        J, prediction = jacfwd(predicted, has_aux=True)(z)
        predictions.append(prediction.detach())
        innovation = J @ covariance @ J.mT + noise * noise * torch.eye(len(J), dtype=z.dtype)
        gain = torch.linalg.solve(innovation, J @ covariance).mT
        z = z + gain @ (positions[n].flatten() - prediction)
        shrunk = eye - gain @ J
        # Joseph's form stays symmetric and positive.
        covariance = shrunk @ covariance @ shrunk.mT + noise * noise * gain @ gain.mT + walk * walk * eye
        scores.append(z)
    return torch.stack(predictions).reshape(positions.shape), torch.stack(scores)
