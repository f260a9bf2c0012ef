"""Tendons with an end: `python examples/tendon_limits.py`.

The tip goes round a circle while no tendon may change by more than 25 mm, nor faster than 50 mm/s. Three ways: no
limits; the finished command cut at the limits; the limits inside the program that chooses the velocity, which then
finds another shape of the arm for the same tip. Prints the errors and writes runs/tendon_limits.png;
`--quick` takes one round instead of two and draws nothing.
"""

from __future__ import annotations

import argparse
from math import pi
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch import InverseKinematics, PCCBackbone
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.control.tendon_limits import ConstrainedVelocity, SolverStatus, TendonLimits
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.tendons import rack_routing
from apcc_torch.report import style

LENGTHS = torch.tensor([0.105, 0.255, 0.240], dtype=torch.float64)
ROUTING = rack_routing(torch.tensor([0.105, 0.36, 0.60], dtype=torch.float64))
B = ROUTING.matrix(LENGTHS)
LIMITS = TendonLimits(*(torch.full((9,), v, dtype=torch.float64) for v in (-0.025, 0.025, 0.05)))
DT, PERIOD = 0.02, 10.0
WAYS = ("no limits", "command cut", "limits in the program")


class Way(NamedTuple):
    """x_d and x (T, 3), m; y (T, 9), m; status (T,) `SolverStatus`."""

    x_d: Tensor
    x: Tensor
    y: Tensor
    status: Tensor


def circle(time: float) -> tuple[Tensor, Tensor]:
    """Desired position and velocity (3,) at a time."""
    a = torch.tensor(2.0 * pi * time / PERIOD, dtype=torch.float64)
    zero = torch.zeros_like(a)
    x_d = torch.stack((0.10 + 0.14 * torch.cos(a), 0.14 * torch.sin(a), zero - 0.53))
    return x_d, 0.14 * 2.0 * pi / PERIOD * torch.stack((-torch.sin(a), torch.cos(a), zero))


def follow(name: str, rounds: int) -> Way:
    """The tip round the circle."""
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))
    inverse_kinematics = InverseKinematics(damping=0.02, null_gain=0.3)
    stack = TaskStack([Task(gain=3.0)], damping=0.02)
    program = ConstrainedVelocity(0.02)
    q = torch.zeros(9, dtype=torch.float64)
    dt = torch.tensor(DT, dtype=torch.float64)
    log = []
    for k in range(round(rounds * PERIOD / DT)):
        x_d, xdot_d = circle(k * DT)
        rates = stack.rates(backbone, q, LENGTHS, [TaskTarget(x_d, xdot_d)])
        descent = inverse_kinematics.descent(q)
        status = torch.tensor(int(SolverStatus.FREE))
        if name == "limits in the program":
            qdot, status = program(rates, B, *LIMITS.rates(B.mT @ q, dt), descent)
        else:
            qdot = stack(rates, descent)
        if name == "command cut":
            # What a motor does that stops at its limits: every tendon by itself. Nine tendons tell nine coordinates.
            y = B.mT @ q
            slowest, fastest = LIMITS.rates(y, dt)
            qdot = torch.linalg.solve(B.mT, torch.clamp(B.mT @ qdot, slowest, fastest))
        log.append((x_d, backbone.tip(q, LENGTHS), B.mT @ q, status))
        q = q + DT * qdot
    return Way(*(torch.stack(column) for column in zip(*log, strict=True)))


def draw(ways: dict[str, Way], file: Path) -> Path:
    """The circle from above, the error, and the tendon that is longest."""
    figure = style.new_figure(12.0, 4.2)
    above, error, tendon = figure.subplots(1, 3, width_ratios=(1.0, 1.3, 1.3))
    late = round(PERIOD / DT)
    x_d = 1e3 * style.values(ways["no limits"].x_d)
    above.plot(x_d[:, 0], x_d[:, 1], color=style.INK, linewidth=1.2, linestyle=":")
    colors = (style.VERMILION, style.ORANGE, style.GREEN)
    for (name, way), color, dash in zip(ways.items(), colors, style.DASHES, strict=False):
        look = {"color": color, "linestyle": dash, "linewidth": style.LINE, "label": name}
        time = DT * style.values(torch.arange(len(way.x)))
        x = 1e3 * style.values(way.x)[late:]
        above.plot(x[:, 0], x[:, 1], **look)
        error.plot(time, 1e3 * style.values((way.x_d - way.x).norm(dim=-1)), **look)
        tendon.plot(time, 1e3 * style.values(way.y.abs().amax(-1)), **look)
    tendon.axhline(25.0, color=style.INK, linewidth=1.0, linestyle=":")
    above.set_aspect("equal")
    style.dress(above, "x (mm)", "y (mm)", "second round, from above")
    style.dress(error, "time (s)", "tip error (mm)")
    style.dress(tendon, "time (s)", "largest tendon change (mm)")
    style.legend(error, loc="upper right")
    return style.save_figure(figure, file, dpi=110)


def main() -> None:
    """Runs, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one round, no figure")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    with torch.inference_mode():
        ways = {name: follow(name, 1 if quick else 2) for name in WAYS}
    for name, way in ways.items():
        e = 1e3 * (way.x_d - way.x).norm(dim=-1)[-round(PERIOD / DT) :]
        speed = (way.y[1:] - way.y[:-1]).abs().amax() / DT
        print(
            f"{name:22s} tip error mean {float(e.mean()):6.2f} mm, max {float(e.max()):6.2f} mm; tendons to"
            f" {1e3 * float(way.y.abs().max()):.4f} mm at up to {1e3 * float(speed):.3f} mm/s;"
            f" {100.0 * float((way.status > 0).double().mean()):.0f} % of steps at a limit"
        )
    if not quick:
        print(draw(ways, Path("runs") / "tendon_limits.png"))


if __name__ == "__main__":
    main()
