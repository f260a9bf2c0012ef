"""Whether the shape's covariance is honest: `python benchmarks/shape_covariance.py`, four minutes.

Arms hang at rest under random tensions and a load that nobody tells, as another solver finds them. Sensors and tendons
are measured with the noise that the estimator is told. After a second and a half, what it is off by is weighed with its
covariance (NEES): over n numbers that are normal the mean is 1. The band is that of the strains.

The lengths are those of the arcs, which the law's rest lengths take over. What they are off by is their difference from
the lengths that the same fit finds for the true arm's curve.
"""

from __future__ import annotations

import argparse
from math import sqrt
from typing import NamedTuple

import torch
from tqdm import tqdm

from apcc_torch import Arm, PCCBackbone, decouple
from apcc_torch.estimation.length_covariance import length_covariance
from apcc_torch.estimation.shape_feedback import SAMPLES, ShapeFeedback, ShapeFeedbackSettings
from apcc_torch.lie import so3
from apcc_torch.model.statics import equilibrium

D = torch.float64
PERIOD = 0.02
SETTLING = 40
"""Steps of the arcs' fit with which it comes to rest."""
PULL = 2.0
"""Largest tension of a tendon, N."""
ARMS = {
    "three sections": Arm(lengths=[0.105, 0.255, 0.24]),
    "reversed": Arm(lengths=[0.24, 0.255, 0.105]),
    "four, standing": Arm(
        lengths=[0.1, 0.15, 0.1, 0.12], base="standing", mass=0.2, bending_stiffness=3.0, axial_stiffness=400.0
    ),
    "four sensors": Arm(lengths=[0.2, 0.2, 0.2], sensors=[0.13, 0.31, 0.47, 0.6]),
    "two sensors": Arm(lengths=[0.105, 0.255, 0.24], sensors=[0.36, 0.6]),
}


class Covered(NamedTuple):
    """Mean NEES of the strains, the load, the middle, the tip and the arcs' lengths; half a 95 % band of the first."""

    strains: float
    load: float
    middle: float
    tip: float
    lengths: float
    band: float


def covered(
    arm: Arm, settings: ShapeFeedbackSettings, oriented: bool = True, rows: int = 300, steps: int = 75, pieces: int = 2
) -> Covered:
    """How an arm's estimates scatter beside their covariance.

    Args:
        arm: The arm.
        settings: Of the estimator, and of the noise.
        oriented: Whether sensors tell orientations.
        rows: Random tensions, loads and noises.
        steps: Of the estimator.
        pieces: Of each section of the true arm.
    """
    draw = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw, dtype=D)

    dynamics = arm.dynamics(pieces)
    load = (float(settings.load) * float(dynamics.masses.sum()) * normal(rows)).abs()
    pulls = PULL * torch.rand(rows, arm.n_tendons, generator=draw, dtype=D)
    solved = equilibrium(dynamics, routing=arm.routing(), tensions=pulls, payload=load)
    q, load = solved.q[solved.converged], load[solved.converged]
    lengths, rows = arm.refined(pieces), len(q)
    model = PCCBackbone(lengths.shape[-1], arm.base_rotation())
    true_T = model.pose(q, lengths, *decouple(arm.sensor_places(), lengths))
    true_y = q @ arm.routing().matrix(lengths)
    feedback, rest = ShapeFeedback.on(arm, arm.backbone(), settings), arm.rest_lengths()
    shape, pi = feedback.shape, rest.expand(rows, -1)
    q_bar = torch.zeros(rows, 3 * arm.n_sections, dtype=D)
    followed = feedback.initial_state(q_bar, pi)
    usable, dt = torch.ones(true_T.shape[:2], dtype=torch.bool), torch.full((rows,), PERIOD, dtype=D)
    P = torch.empty(0)
    for _ in range(steps):
        T, k = true_T.clone(), true_T.shape[1]
        T[..., :3, 3] += float(settings.position_noise) * normal(rows, k, 3)
        T[..., :3, :3] = true_T[..., :3, :3] @ so3.exp(float(settings.angular_noise) * normal(rows, k, 3))
        y = true_y + float(settings.tendon_noise) * normal(*true_y.shape)
        P = shape.covariance(followed.shape, T, usable, usable & oriented, y, dt)
        followed, q_bar = feedback(followed, q_bar, pi, T, usable, usable & oriented, y, dt)
    state = followed.shape
    curve, true_curve = feedback.curve(state), _curve(model, q, lengths)
    true_q = q_bar
    for _ in range(SETTLING):
        q_bar, true_q = feedback.fit(q_bar, pi, *curve), feedback.fit(true_q, pi, *true_curve)
    longer = (q_bar - true_q)[:, 2::3]
    points = torch.stack((0.5 * rest.sum(), rest.sum()))
    own = shape.dynamics.lengths
    found = shape.backbone.pose(shape.configuration(state), own, *decouple(points, own))[..., :3, 3]
    off = found - model.pose(q, lengths, *decouple(points, lengths))[..., :3, 3]
    at_points = _weighed(off, shape.point_covariance(state, P, points))
    strain = shape.strain(state) - q.unflatten(-1, (-1, pieces, 3)).sum(-2).flatten(-2)
    n = strain.shape[-1]
    return Covered(
        float(_weighed(strain, P[:, :n, :n])),
        float(((state.load - load) ** 2 / P[:, -1, -1]).mean()),
        float(at_points[0]),
        float(at_points[1]),
        float(_weighed(longer, length_covariance(feedback, followed, q_bar, pi, P))),
        1.96 * sqrt(2.0 / (rows * n)),
    )


def _curve(model: PCCBackbone, q: torch.Tensor, lengths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (rows, N, 3) of the true arm, `SAMPLES` on each piece, and their shares of its length (rows, N)."""
    pieces = lengths.shape[-1]
    part = (torch.arange(1, SAMPLES + 1, dtype=D) / SAMPLES).repeat(pieces).expand(len(q), -1)
    piece = torch.arange(pieces).repeat_interleave(SAMPLES).expand(len(q), -1)
    own = lengths.expand(len(q), -1)
    points = model.chain_to(q, model.material_points(own, part, piece)).tip
    now = model.section_lengths(q, own)
    ends = now.cumsum(-1)
    along = torch.gather(ends - now, -1, piece) + part * torch.gather(now, -1, piece)
    return points, along / ends[:, -1:]


def _weighed(off: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Mean over the rows of the squares of off (rows, ..., n), weighed with its covariance, over n."""
    return (off * torch.linalg.solve(covariance, off.unsqueeze(-1)).squeeze(-1)).mean(-1).mean(0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curve-noise", type=float, help="of the arcs' fit, over the arm's length; as shipped")
    told = parser.parse_args().curve_noise
    settings = ShapeFeedbackSettings() if told is None else ShapeFeedbackSettings(curve_noise=told)
    torch.set_num_threads(1)
    cases = {f"{name}, poses": (arm, True, 2) for name, arm in ARMS.items()}
    cases |= {f"{name}, positions": (arm, False, 2) for name, arm in ARMS.items()}
    cases["three sections of six pieces each, poses"] = (ARMS["three sections"], True, 6)
    lines = ["| arm, sensors | strains | load | middle | tip | lengths | 95 % band |", "|---|---|---|---|---|---|---|"]
    for name, (arm, oriented, pieces) in tqdm(cases.items(), desc="arms"):
        found = covered(arm, settings, oriented, pieces=pieces)
        lines.append(f"| {name} | " + " | ".join(f"{x:.2f}" for x in found[:5]) + f" | 1 ± {found.band:.2f} |")
    print(*lines, sep="\n")
