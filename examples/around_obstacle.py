"""The arm reaches a point beside a ball and bends around it: `python examples/around_obstacle.py`.

The same reach twice, without and with the clearance cost in the null space of the tip's task. Prints the smallest
distance of the arm's surface from the ball and writes runs/around_obstacle.png; `--quick` draws nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch import InverseKinematics, PCCBackbone
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.obstacles import Sphere
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.model.backbone import HANGING
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_base, draw_target
from apcc_torch.report.space import Camera, Space, bounding_box

LENGTHS = torch.tensor([0.105, 0.255, 0.240], dtype=torch.float64)
CENTRE = torch.tensor([0.16, 0.0, -0.27], dtype=torch.float64)
RADIUS = 0.07
ARM_RADIUS = 0.03
GOAL = torch.tensor([0.30, 0.0, -0.42], dtype=torch.float64)
DT, STEPS = 0.01, 600


def reach(backbone: PCCBackbone, cost: ClearanceCost, avoiding: bool) -> Tensor:
    """Configurations (STEPS, 9) on the way from the hanging arm to the goal."""
    inverse_kinematics = InverseKinematics(null_gain=0.05, bend_rate=2.0, length_rate=0.2)
    stack = TaskStack([Task("position", gain=1.5)])
    q = torch.zeros(9, dtype=torch.float64)
    way = []
    for _ in range(STEPS):
        rates = stack.rates(backbone, q, LENGTHS, [TaskTarget(GOAL)])
        descent = inverse_kinematics.descent(q)
        if avoiding:
            descent = descent + cost.descent(backbone, q, LENGTHS)
        q = q + DT * inverse_kinematics.bounded(stack(rates, descent))
        way.append(q)
    return torch.stack(way)


def draw(backbone: PCCBackbone, ways: dict[str, Tensor], gaps: dict[str, Tensor], path: Path) -> Path:
    """Both ways in the plane of the ball, and the clearance over time."""
    figure = style.new_figure(11.0, 4.4)
    axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.4))
    moments = [0, 40, 80, 140, STEPS - 1]
    arms = {name: style.values(backbone.points(q[moments], LENGTHS, 80)) for name, q in ways.items()}
    box = bounding_box(*arms.values(), margin=0.08)
    ball = style.values(CENTRE) + RADIUS * circle()
    looks = zip((style.VERMILION, style.BLUE), style.DASHES, strict=False)
    time = DT * torch.arange(1, STEPS + 1)
    for ax, (name, arm), (color, dash) in zip(axes, arms.items(), looks, strict=False):
        space = Space(ax, box, Camera(elevation=0.0, azimuth=-90.0), frame=False)
        draw_base(space)
        space.plot(ball, color=style.INK, linewidth=1.6)
        for k, shape in enumerate(arm):
            space.plot(shape, color=style.faded(color, 0.3 + 0.7 * k / (len(arm) - 1)), linewidth=6.0, zorder=2 + k)
        draw_target(space, style.values(GOAL))
        ax.set_title(name, fontsize=style.TITLE, color=style.INK)
        axes[2].plot(style.values(time), 1e3 * style.values(gaps[name]), color=color, linestyle=dash, label=name)
    axes[2].axhline(0.0, color=style.INK, linewidth=1.0)
    style.dress(axes[2], "time (s)", "clearance from the ball (mm)")
    style.legend(axes[2], loc="center right")
    return style.save_figure(figure, path, dpi=110)


def circle() -> style.Array:
    """A circle (N, 3) of radius 1 in the plane of x and z."""
    angle = torch.linspace(0.0, 6.2832, 90, dtype=torch.float64)
    return style.values(torch.stack((torch.cos(angle), torch.zeros_like(angle), torch.sin(angle)), dim=-1))


def main() -> None:
    """Runs, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="no figure")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))
    cost = ClearanceCost([Sphere(CENTRE, RADIUS)], radius=ARM_RADIUS, activation=0.05, points=40, gain=1.0)
    with torch.inference_mode():
        ways = {name: reach(backbone, cost, name == "kept clear") for name in ("no look at the ball", "kept clear")}
        gaps = {name: cost.clearance(backbone, q, LENGTHS).obstacles for name, q in ways.items()}
        for name, q in ways.items():
            miss = 1e3 * float((backbone.tip(q[-1], LENGTHS) - GOAL).norm())
            low, end = 1e3 * float(gaps[name].min()), 1e3 * float(gaps[name][-1])
            print(f"{name:22s} clearance: least {low:6.1f} mm, at the end {end:6.1f} mm; tip error {miss:.3f} mm")
    if not quick:
        print(draw(backbone, ways, gaps, Path("runs") / "around_obstacle.png"))


if __name__ == "__main__":
    main()
