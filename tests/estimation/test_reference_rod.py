"""The tip force of a Cosserat rod of another simulator, from twelve positions along it."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import torch

from apcc_torch import StateFeedback
from apcc_torch.estimation.feedback_covariance import feedback_covariance
from apcc_torch.estimation.weighted_estimate import weighted_estimate
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.static_body import StaticBody
from skips import no_recording

D = torch.float64
LENGTH, RADIUS, DENSITY, MODULUS = 0.4, 0.005, 1200.0, 70e6
COUNT, SECTIONS = 24, 4


def test_the_tip_force_of_a_rod_with_known_weight_and_mid_wrench(shared_data: Path) -> None:
    path = shared_data / "sorosim_statics" / "TPURod_statics.csv"
    if not path.is_file():
        no_recording(str(path))
    with path.open() as file:
        rows = list(csv.reader(file))[2:]
    table = torch.tensor([[float(v) for v in row[1:]] for row in rows[: 6 * COUNT]], dtype=D).view(COUNT, 2, 3, -1)
    to_world = torch.tensor([[0, 0, 1], [0, -1, 0], [1, 0, 0]], dtype=D)
    torques, vectors = to_world @ table[:, 0], to_world @ table[:, 1]
    stations = [4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15, 16]  # without the base, and the middle once
    half = 0.5 * LENGTH * torch.tensor([0.0469, 0.2308, 0.5, 0.7692, 0.9531, 1.0], dtype=D)
    T = torch.eye(4, dtype=D).repeat(COUNT, 12, 1, 1)
    T[..., :3, 3] = vectors[..., stations].mT

    model = AffineBackbone(SECTIONS, torch.eye(3, dtype=D))
    pi = torch.full((COUNT, SECTIONS), LENGTH / SECTIONS, dtype=D)
    feedback = StateFeedback(
        model, torch.cat((half, half + 0.5 * LENGTH)), mode="position", max_iterations=60, damping=1e-6
    )  # fmt: skip
    q = feedback(torch.zeros(COUNT, model.n, dtype=D), pi, T).q_bar
    area = math.pi * RADIUS**2
    body = StaticBody(model, DENSITY * area, MODULUS * area, MODULUS * math.pi * RADIUS**4 / 4, gravity=0.0)

    # The weight points another way in every shape, so it is laid on as forces at the mass points.
    X = (torch.arange(80, dtype=D) + 0.5) / 80 * LENGTH
    weight = (DENSITY * area * LENGTH / 80 * vectors[..., 0]).unsqueeze(1)
    r = body.stiffness(pi) * q - (body.point_jacobians(q, pi, X).mT @ weight.unsqueeze(-1)).squeeze(-1).sum(1)
    ends = torch.tensor([0.5 * LENGTH, LENGTH], dtype=D).expand(COUNT, 2)
    pose, J = model.pose_and_body_jacobian(q, pi, *decouple(ends, pi))
    turn, move = pose[..., :3, :3] @ J[..., :3, :], pose[..., :3, :3] @ J[..., 3:, :]
    known = turn.mT @ torques[..., [1, 2]].mT.unsqueeze(-1)
    known[:, 0] += move[:, 0].mT @ vectors[..., 1:2]
    r = r - known.squeeze(-1).sum(1)

    K = torch.diag_embed(body.stiffness(pi))
    Q = feedback_covariance(feedback, q, pi, 1e-4, 1.0)
    S = K @ Q @ K + torch.diag(model.coordinates.per_unit(1e-3, 1e-2, model.n, q) ** 2)
    found = weighted_estimate(r, move[:, 1].mT, S, torch.full((3,), 50.0, dtype=D))
    force = vectors[..., 2]
    error = (found.value - force).norm(dim=-1)
    # Positions come with four decimals, forces are 0.3 N.
    assert float(error.median()) < 0.02 * float(force.norm(dim=-1).median())
    assert float(error.max()) < 0.08
    assert bool((error < 4.0 * found.deviation.norm(dim=-1)).all())
