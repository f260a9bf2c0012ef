"""A soft arm on a gantry follows a path longer than either alone could: `python examples/gantry.py`.

The whole body has 13 coordinates: two rails, a lift, a turntable and three soft sections. The tip follows a wave 1.8 m
long, twice: with the rails as cheap to move as the arm, and with rails that cost more. Near the ends the x rail stops
at its limit and the arm reaches on. Prints errors and who moved, and writes runs/gantry.png; `--quick` takes
larger steps and draws nothing.
"""

from __future__ import annotations

import argparse
from math import pi
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch import PCCBackbone
from apcc_torch.control.bounds import RateBounds
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.model.mount import MountedArm, RigidMount
from apcc_torch.report import style
from apcc_torch.report.space import Camera, Space, bounding_box

LENGTHS = torch.tensor([0.105, 0.255, 0.240], dtype=torch.float64)
URDF = Path(__file__).parent / "urdf" / "gantry.urdf"
DURATION = 40.0


class Way(NamedTuple):
    """s (T, 13), the wanted x_d (T, 3), m, the tip x (T, 3), m, and the period dt, s."""

    s: Tensor
    x_d: Tensor
    x: Tensor
    dt: float


def path(time: Tensor) -> tuple[Tensor, Tensor]:
    """Desired position and velocity (3,) at a time: once to and fro over 1.8 m, weaving."""
    a = 2.0 * pi * time / DURATION
    rate = 2.0 * pi / DURATION
    x_d = torch.stack((0.9 * torch.sin(a), 0.15 * torch.sin(6.0 * a), 0.80 + 0.05 * torch.cos(4.0 * a)))
    xdot_d = rate * torch.stack((0.9 * torch.cos(a), 0.9 * torch.cos(6.0 * a), -0.2 * torch.sin(4.0 * a)))
    return x_d, xdot_d


def follow(body: MountedArm, rail_weight: float, dt: float) -> Way:
    """The tip along the path; the rails' rates cost `rail_weight` times the bends'."""
    m, n = body.mount.n_joints, body.arm.n
    weights = torch.ones(m + n, dtype=torch.float64)
    weights[:m] = rail_weight
    # A metre of elongation is dearer than a radian of bend.
    weights[m + 2 :: 3] = 100.0
    stack = TaskStack([Task("position", gain=4.0)], damping=1e-3, coordinate_weights=weights)
    soft = InverseKinematics(null_gain=0.1)
    s = torch.zeros(m + n, dtype=torch.float64)
    s[2] = 0.08
    log = []
    for k in range(round(DURATION / dt)):
        x_d, xdot_d = path(torch.tensor(k * dt, dtype=torch.float64))
        rates = stack.rates(body, s, LENGTHS, [TaskTarget(x_d, xdot_d)])
        joints, q = body.split(s)
        # In the null space the arm likes to hang straight, and the sections to keep their lengths.
        descent = torch.cat((torch.zeros_like(joints), soft.descent(q) - 0.3 * q))
        log.append((s, x_d, body.tip(s, LENGTHS)))
        s = s + dt * stack(rates, descent, RateBounds(*body.rate_bounds(s, dt)))
    states, wanted, tips = (torch.stack(column) for column in zip(*log, strict=True))
    return Way(states, wanted, tips, dt)


def report(body: MountedArm, name: str, way: Way) -> str:
    """One line: the error after the start, how far the joints went, how much the arm bent."""
    e = 1e3 * (way.x_d - way.x).norm(dim=-1)[round(2.0 / way.dt) :]
    joints, q = body.split(way.s)
    inside = bool(((joints >= body.mount.lower - 1e-9) & (joints <= body.mount.upper + 1e-9)).all())
    bend = torch.rad2deg(q.unflatten(-1, (-1, 3))[..., :2].norm(dim=-1).amax())
    travel = joints[1:].sub(joints[:-1]).abs().sum(0)
    return (
        f"{name:14s} tip error mean {float(e.mean()):5.2f} mm, max {float(e.max()):5.2f} mm; rails travel"
        f" {float(travel[0]):.2f} + {float(travel[1]):.2f} m, x to {float(joints[:, 0].abs().max()):.3f} m;"
        f" largest bend {float(bend):4.0f} deg; limits {'held' if inside else 'BROKEN'}"
    )


def draw(body: MountedArm, ways: dict[str, Way], file: Path) -> Path:
    """The body at moments of both ways, and the x rail over time."""
    figure = style.new_figure(12.0, 3.9)
    axes = figure.subplots(1, 3, width_ratios=(1.3, 1.3, 1.0))
    looks = list(zip((style.VERMILION, style.BLUE), style.DASHES, strict=False))
    box = bounding_box(*(style.values(way.x_d) for way in ways.values()), margin=0.15)
    box = box._replace(low=box.low * (1, 1, 0) + (0, 0, 0.7), high=box.high * (1, 1, 0) + (0, 0, 1.55))
    for ax, (name, way), (color, dash) in zip(axes, ways.items(), looks, strict=False):
        space = Space(ax, box, Camera(elevation=12.0, azimuth=-75.0), frame=False)
        space.plot(style.values(way.x_d), color=style.MUTED, linewidth=1.3, linestyle=":")
        for share in (0.0, 0.08, 0.17, 0.25, 0.67, 0.75):
            s = way.s[round(share * (len(way.s) - 1))]
            links = style.values(body.mount.link_positions(body.split(s)[0]))
            bridge = links[[1, 1]] * (1, 0, 1) + ((0, -0.4, 0), (0, 0.4, 0))
            space.plot(bridge, color=style.EDGE, linewidth=2.0)
            space.plot(links[2:], color=style.INK, linewidth=3.0, solid_capstyle="butt")
            space.plot(style.values(body.points(s, LENGTHS, 60)), color=color, linewidth=3.0, solid_capstyle="round")
        for side in (-1.0, 1.0):
            rail = torch.tensor([[-0.6, 0.4 * side, 1.5], [0.6, 0.4 * side, 1.5]])
            space.plot(style.values(rail), color=style.EDGE, linewidth=2.0)
        ax.set_title(name, fontsize=style.TITLE, color=style.INK)
        time = style.values(way.dt * torch.arange(len(way.s)))
        axes[2].plot(time, style.values(way.s[:, 0]), color=color, linestyle=dash, linewidth=style.LINE, label=name)
    for limit in (-0.6, 0.6):
        axes[2].axhline(limit, color=style.INK, linewidth=1.0, linestyle=":")
    style.dress(axes[2], "time (s)", "x rail (m), dotted: its limits")
    style.legend(axes[2], loc="upper right")
    return style.save_figure(figure, file, dpi=110)


def main() -> None:
    """Runs, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="steps of 0.1 s, no figure")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    # The flange looks down, so the arm hangs from it without a base rotation of its own.
    body = MountedArm(RigidMount(URDF, "flange"), PCCBackbone(3))
    with torch.inference_mode():
        ways = {
            name: follow(body, weight, 0.1 if quick else 0.02)
            for name, weight in {"equal rails": 1.0, "costly rails": 30.0}.items()
        }
        for name, way in ways.items():
            print(report(body, name, way))
        if not quick:
            print(draw(body, ways, Path("runs") / "gantry.png"))


if __name__ == "__main__":
    main()
