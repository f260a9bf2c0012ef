"""Draws the README's picture: `python examples/hero.py` writes runs/hero.png.

Section V-A twice, with the adaptive and with the standard controller, both starting from the same wrong rest lengths.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

import torch

from apcc_torch import (
    AdaptiveLaw,
    APCCController,
    InverseKinematics,
    PCCBackbone,
    SavitzkyGolay,
    StateFeedback,
)
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.model.backbone import HANGING
from apcc_torch.report.backbone_drawing import marker_positions
from apcc_torch.report.hero import hero_figure
from apcc_torch.report.style import save_figure
from apcc_torch.simulation.kinematic import KinematicLog, simulate_feedback
from apcc_torch.simulation.metrics import backbone_error

TRUE = torch.tensor([0.105, 0.255, 0.240], dtype=torch.float64)
GUESS = torch.tensor([0.120, 0.280, 0.270], dtype=torch.float64)
SENSORS = torch.tensor([0.105, 0.36, 0.60], dtype=torch.float64)
RATE = 100.0
DURATION = 13.0
MOMENTS = (7.4, 9.2, 10.9, 12.4)


def run(backbone: PCCBackbone, adaptive: bool) -> KinematicLog:
    """One run of section V-A."""
    controller = APCCController(
        backbone,
        StateFeedback(backbone, SENSORS),
        SavitzkyGolay(window=15, order=2),
        InverseKinematics(K=1.0, null_gain=1.0),
        AdaptiveLaw(3, [9.0, 4.25, 3.5]),
        bounds=LengthBounds(TRUE, SENSORS, lower=None, upper=None, reach="last"),
        adaptive=adaptive,
        velocity="commanded",
    )
    path = SineTrajectory(
        torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64),
        torch.tensor([0.5, 0.3, 0.1], dtype=torch.float64),
        0.2 * pi,
    )
    with torch.inference_mode():
        return simulate_feedback(controller, TRUE, GUESS, path, DURATION, RATE)


def main() -> None:
    """Runs both and draws."""
    torch.set_num_threads(1)
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))
    logs = {"fixed model": run(backbone, False), "adapted model": run(backbone, True)}
    arm = logs["adapted model"]
    at = [round(t * RATE) for t in MOMENTS]

    def shape_error(log: KinematicLog) -> torch.Tensor:
        return backbone_error(backbone, log.q_true[::5], TRUE, backbone, log.q_bar[::5], log.pi_hat[::5])

    # The two runs move alike, so one arm carries both models: the fixed model is fitted to the adapted run's sensors.
    fixed_feedback = StateFeedback(backbone, SENSORS, max_iterations=20)
    seen = backbone.pose(arm.q_true[at], TRUE, *_places(TRUE))
    fixed_q = fixed_feedback(arm.q_true[at], GUESS.expand(len(at), 3), seen).q_bar
    figure = hero_figure(
        backbone.points(arm.q_true[at], TRUE, 120),
        {
            "fixed model": backbone.points(fixed_q, GUESS, 120),
            "adapted model": backbone.points(arm.q_bar[at], arm.pi_hat[at], 120),
        },
        marker_positions(backbone, arm.q_true[at], TRUE, SENSORS),
        arm.time[::5],
        {name: shape_error(log) for name, log in logs.items()},
        path=arm.x_d,
    )
    print(save_figure(figure, Path("runs") / "hero.png", dpi=110))


def _places(lengths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Normalised abscissae and sections of the sensors on an arm of these lengths."""
    from_base = lengths.cumsum(-1)
    j = torch.arange(lengths.shape[-1])
    return torch.ones_like(from_base), j


if __name__ == "__main__":
    main()
