"""Learns what a wrong tendon layout does to an arm: `python examples/layout_residual.py`, with `--quick` in seconds.

The arm's tendons are independent, carried to their sections by sheaths; the model believes them coupled, running from
the base. So tendon lengths B^T q_d put the tip elsewhere than the model says: the mapping error of Eq. (53). A small
network adds tendon lengths to the model's, f(q_d), and is trained through the arm's equilibrium under gravity. It is
tried on set-points that it has not seen: at rest, and in the closed loop with a moving arm.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch import APCCController, InverseKinematics, PCCBackbone, SavitzkyGolay, StateFeedback
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.simulation.dynamic import DynamicSettings, simulate_dynamic
from apcc_torch.simulation.kinematic import start_configuration
from apcc_torch.simulation.metrics import mapping_error
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors

D = torch.float64
MODEL = torch.tensor([0.105, 0.255, 0.240], dtype=D)
ARM = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)
RACKS = MODEL.cumsum(0)
BASE = torch.tensor(HANGING, dtype=D)
BACKBONE = PCCBackbone(3, BASE)
TENDON_STIFFNESS = 2e4  # N/m, as on the platform
LAYOUTS = {name: rack_routing(RACKS, layout=name) for name in ("coupled", "independent")}


class Residual(nn.Module):
    """Tendon lengths (..., 9), m, to add at q_d (..., 9): zero at first."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.linear = nn.Linear(9, 9, dtype=D)
        self.inner = nn.Sequential(nn.Linear(9, width, dtype=D), nn.Tanh(), nn.Linear(width, 9, dtype=D))
        for last in (self.linear, self.inner[-1]):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        # Bends are of order 1 rad, elongations of order 1 cm, tendon lengths of order 1 cm.
        self.register_buffer("scale", torch.tensor([1.0, 1.0, 100.0] * 3, dtype=D))

    def forward(self, q_d: Tensor) -> Tensor:
        scaled = self.scale * q_d
        return 0.01 * (self.linear(scaled) + self.inner(scaled))


class CorrectedController(APCCController):
    """A controller that adds a residual to its tendon lengths; other arguments as `APCCController`."""

    def __init__(self, residual: Residual | None, *settings: Any, **named: Any) -> None:
        super().__init__(*settings, **named)
        self.residual = residual

    def tendons(self, q: Tensor, pi_hat: Tensor) -> Tensor | None:
        y = super().tendons(q, pi_hat)
        return y if y is None or self.residual is None else y + self.residual(q)


class SetPoints(NamedTuple):
    """Positions x (S, 3), m, and configurations q_d (S, 9) whose modelled tip is there."""

    x: Tensor
    q_d: Tensor


def set_points(count: int, seed: int) -> SetPoints:
    """Positions within reach, spread by random bends."""
    generator = torch.Generator().manual_seed(seed)
    q = (2.0 * torch.rand(count, 3, 3, generator=generator, dtype=D) - 1.0) * torch.tensor([0.4, 0.4, 0.01], dtype=D)
    x = BACKBONE.tip(q.flatten(-2), MODEL)
    return SetPoints(x, start_configuration(BACKBONE, MODEL, x))


def dynamics() -> SoftArmDynamics:
    """The true arm."""
    return SoftArmDynamics(ARM, ARM / ARM.sum(), *scaled_stiffness(ARM), damping_ratio=0.1, base_rotation=BASE)


def at_rest(y: Tensor, first: Tensor | None) -> Tensor:
    """The arm (S, 18) at rest with tendon lengths y (S, 9), from a first guess."""
    found = equilibrium(
        dynamics(), routing=LAYOUTS["independent"], tendon_lengths=y, compliance=1.0 / TENDON_STIFFNESS, q=first
    )
    if not bool(found.converged.all()):
        raise RuntimeError(f"{int((~found.converged).sum())} shapes at rest were not found")
    return found.q


def error_at_rest(points: SetPoints, y: Tensor, first: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Mapping errors (S,), m, of tendon lengths y (S, 9), and the arm's shapes (S, 18)."""
    q = at_rest(y, first)
    tip = PCCBackbone(6, BASE).tip(q, ARM)
    return mapping_error(BACKBONE, points.q_d, MODEL, tip), q


def commanded(routing: TendonRouting, points: SetPoints) -> Tensor:
    """B^T q_d (S, 9), m, of a layout."""
    return routing.lengths(points.q_d, MODEL.expand(len(points.q_d), 3))


def train(points: SetPoints, iterations: int) -> Residual:
    """A residual trained on set-points, by Adam through the arm's equilibrium."""
    torch.manual_seed(0)
    residual = Residual()
    optimizer = torch.optim.Adam(residual.parameters(), lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    coupled, shapes = commanded(LAYOUTS["coupled"], points), None
    for k in range(iterations):
        errors, shapes = error_at_rest(points, coupled + residual(points.q_d), shapes)
        shapes = shapes.detach()  # the next shapes are near
        optimizer.zero_grad()
        (1e4 * errors.square().mean()).backward()
        optimizer.step()
        schedule.step()
        if k % 20 == 0:
            print(f"{k:4d}  mapping error {1e2 * errors.detach().mean():.3f} cm", flush=True)
    return residual


def error_in_motion(points: SetPoints, routing: TendonRouting, residual: Residual | None, duration: float) -> Tensor:
    """Mean mapping errors (S,), m, of the closed loop on its way to set-points."""
    controller = CorrectedController(
        residual,
        BACKBONE,
        StateFeedback(BACKBONE, RACKS, angular_weight=0.1),
        SavitzkyGolay(15, 2),
        InverseKinematics(1.8, null_gain=0.05),
        routing=routing,
        adaptive=False,
        bend_bound=3.0,
        elongation_bound=0.3,
    )
    payload = torch.zeros(len(points.x), dtype=D)
    pid = TendonPID(K_P=TENDON_STIFFNESS, K_I=1.0, K_D=5.0)
    plant = Plant(dynamics(), LAYOUTS["independent"], pid, payload, substeps=4, settle=min(duration, 2.0))
    settings = DynamicSettings(duration=duration, control_rate=50.0)
    log = simulate_dynamic(plant, controller, PoseSensors(), SetPoint(points.x), MODEL, settings)
    if bool((log.diverged_at >= 0).any()):
        raise RuntimeError("an arm diverged")
    return mapping_error(BACKBONE, log.q_d, log.pi_hat, log.x).mean(0)


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Trains and prints; returns the mean mapping errors in cm, held out, at rest and in motion."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few set-points and steps, to see it run")
    quick = parser.parse_args(arguments).quick
    torch.set_num_threads(1)
    residual = train(set_points(8 if quick else 64, 0), 25 if quick else 200)
    unseen = set_points(4 if quick else 32, 1)
    ways: dict[str, tuple[TendonRouting, Residual | None]] = {
        "coupled, as believed": (LAYOUTS["coupled"], None),
        "coupled with the residual": (LAYOUTS["coupled"], residual),
        "independent, as it is": (LAYOUTS["independent"], None),
    }
    found: dict[str, dict[str, float]] = {"at rest": {}, "in motion": {}}
    moving = SetPoints(*(part[: 2 if quick else 8] for part in unseen))
    with torch.no_grad():
        for name, (routing, correction) in ways.items():
            y = commanded(routing, unseen)
            still, _ = error_at_rest(unseen, y if correction is None else y + correction(unseen.q_d))
            found["at rest"][name] = 1e2 * float(still.mean())
            moved = error_in_motion(moving, routing, correction, 0.2 if quick else 6.0)
            found["in motion"][name] = 1e2 * float(moved.mean())
    for where, errors in found.items():
        for name, error in errors.items():
            print(f"held-out set-points, {where}, {name}: mapping error {error:.2f} cm")
    return found


if __name__ == "__main__":
    main()
