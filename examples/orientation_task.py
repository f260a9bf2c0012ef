"""The tip follows a path and keeps its direction: `python examples/orientation_task.py`.

Section V-A with a level circle, three times: position alone, position and "point straight down", position and a whole
orientation. The rest lengths are wrong at first, and the law learns them from the tip's position in all three.
Prints the errors and writes runs/orientation_task.png; `--quick` runs 2 s and draws nothing.
"""

from __future__ import annotations

import argparse
from math import pi
from pathlib import Path

import torch
from torch import Tensor, nn

from apcc_torch import InverseKinematics, PCCBackbone, SavitzkyGolay, StateFeedback, Target
from apcc_torch.control.adaptation import NormalisedLaw
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.tasks import Task, TaskTarget, shortest_turn
from apcc_torch.lie import so3
from apcc_torch.model.backbone import HANGING
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_base
from apcc_torch.report.space import Space, bounding_box
from apcc_torch.simulation.kinematic import KinematicLog, simulate_feedback

TRUE = torch.tensor([0.105, 0.255, 0.240], dtype=torch.float64)
GUESS = torch.tensor([0.120, 0.280, 0.270], dtype=torch.float64)
SENSORS = torch.tensor([0.105, 0.36, 0.60], dtype=torch.float64)
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
RATE = 100.0
TASKS = {"position": None, "position and direction": "direction", "position and orientation": "orientation"}


class Round(nn.Module):
    """A level circle for the tip, whose axes should be as they are when the arm hangs straight."""

    def __init__(self, further: bool, radius: float = 0.14, height: float = -0.55, omega: float = 0.2 * pi) -> None:
        super().__init__()
        self.further = further
        self.radius, self.height, self.omega = radius, height, omega

    def forward(self, time: Tensor) -> Target:
        """Target at time (...), s."""
        angle, zero = self.omega * time, torch.zeros_like(time)
        cos, sin = self.radius * torch.cos(angle), self.radius * torch.sin(angle)
        x_d = torch.stack((cos, sin, zero + self.height), dim=-1)
        xdot_d = self.omega * torch.stack((-sin, cos, zero), dim=-1)
        R_d = torch.tensor(HANGING, dtype=time.dtype)
        return Target(x_d, xdot_d, (TaskTarget(R_d=R_d, direction=DOWN.to(time)),) if self.further else None)


def run(backbone: PCCBackbone, what: str | None, duration: float) -> KinematicLog:
    """One closed loop; `what` is the kind of the task beside the position, None for none."""
    controller = TaskController(
        backbone,
        StateFeedback(backbone, SENSORS),
        SavitzkyGolay(window=15, order=2),
        InverseKinematics(K=2.0, null_gain=1.0),
        NormalisedLaw(3, gamma=[90.0, 42.5, 35.0]),
        bounds=LengthBounds(TRUE, SENSORS, lower=None, upper=None, reach="last"),
        velocity="commanded",
        tasks=[] if what is None else [Task(what, gain=2.0)],
    )
    with torch.inference_mode():
        return simulate_feedback(controller, TRUE, GUESS, Round(what is not None), duration, RATE)


def tip_rotation(backbone: PCCBackbone, log: KinematicLog) -> Tensor:
    """The true tip's orientation (T, 3, 3)."""
    last = torch.ones(1, dtype=torch.float64), torch.tensor([2])
    return backbone.pose(log.q_true, TRUE, *last)[:, 0, :3, :3]


def errors(backbone: PCCBackbone, log: KinematicLog) -> dict[str, Tensor]:
    """Over time (T,): the tip's position error, mm, its tilt from straight down and its whole turn, degrees."""
    R = tip_rotation(backbone, log)
    turn = so3.log(torch.tensor(HANGING, dtype=torch.float64) @ R.mT).norm(dim=-1)
    return {
        "position_mm": 1e3 * (log.x_d - log.x).norm(dim=-1),
        "tilt_deg": torch.rad2deg(shortest_turn(R, DOWN).norm(dim=-1)),
        "turn_deg": torch.rad2deg(turn),
    }


def draw(backbone: PCCBackbone, logs: dict[str, KinematicLog], path: Path) -> Path:
    """Arms along the path, and the orientation error over time."""
    figure = style.new_figure(13.0, 4.4)
    axes = figure.subplots(1, 4, width_ratios=(1.0, 1.0, 1.0, 1.9))
    at = list(range(int(10.0 * RATE), int(20.0 * RATE), int(1.25 * RATE)))
    arms = {name: style.values(backbone.points(log.q_true[at], TRUE, 80)) for name, log in logs.items()}
    box = bounding_box(*arms.values(), margin=0.07)
    looks = list(zip((style.VERMILION, style.BLUE, style.GREEN), style.DASHES, strict=False))
    for ax, (name, log), (color, dash) in zip(axes, logs.items(), looks, strict=False):
        space = Space(ax, box, frame=False)
        draw_base(space)
        space.plot(style.values(log.x_d), color=style.MUTED, linewidth=1.4, linestyle=":")
        for arm in arms[name]:
            space.plot(arm, color=color, linewidth=2.6, alpha=0.8, solid_capstyle="round")
        ax.set_title(name.replace("position and", "and its"), fontsize=style.TITLE, color=style.INK, pad=-10)
        turn = style.values(errors(backbone, log)["turn_deg"])
        axes[-1].plot(style.values(log.time), turn, color=color, linestyle=dash, linewidth=style.LINE, label=name)
    style.dress(axes[-1], "time (s)", "angle of the tip's orientation error (°)")
    style.fit_time(axes[-1], style.values(logs["position"].time))
    style.legend(axes[-1], loc="upper right")
    axes[-1].set_ylim(0.0, 32.0)
    return style.save_figure(figure, path, dpi=110)


def main() -> None:
    """Runs, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="2 s, no figure")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))
    logs = {name: run(backbone, what, 2.0 if quick else 20.0) for name, what in TASKS.items()}
    print(f"{'largest of the last quarter':26s} position (mm)  tilt (deg)  turn (deg)  rest lengths (mm)")
    for name, log in logs.items():
        late = {key: float(value[3 * len(value) // 4 :].max()) for key, value in errors(backbone, log).items()}
        gap = 1e3 * float((log.pi_hat[-1] - TRUE).abs().max())
        print(f"{name:26s} {late['position_mm']:13.2f} {late['tilt_deg']:11.2f} {late['turn_deg']:11.2f} {gap:18.1f}")
    if not quick:
        print(draw(backbone, logs, Path("runs") / "orientation_task.png"))


if __name__ == "__main__":
    main()
