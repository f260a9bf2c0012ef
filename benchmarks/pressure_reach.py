"""What pressures can do: `python benchmarks/pressure_reach.py` prints the least tip error of each set-point of V-B.

Over pressures within their limits, of the true arm at rest under its payload, the truth known: a Levenberg-Marquardt
search with bounds from several starts, by the statics alone. No controller has a part in it. Beside the error stand the
pressures found that are farthest from a limit, and how far. What does not rest stably does not count. `--arm` takes
another arm with chambers, whose set-points and payloads are in proportion.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from apcc_torch import compose
from apcc_torch.model.statics import equilibrium, load_stiffness
from apcc_torch.simulation.plant import Plant

STARTS, STEPS = 6, 50
UNIT = 1e5
"""Pa, in which steps are taken."""


def tips(plant: Plant, p: Tensor, q: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Where the tip (R, 3) rests under pressures p (R, n_a), Pa, its q (R, n), and whether it rests stably (R,)."""
    assert plant.valves is not None  # the arm has chambers
    rest = equilibrium(
        plant.dynamics, routing=plant.routing, tensions=-plant.valves.forces(p), payload=plant.payload, q=q
    )
    stable = torch.linalg.eigvalsh(stiffness(plant, rest.q))[..., 0] > 0.0
    return plant.backbone.tip(rest.q, plant.dynamics.lengths), rest.q, rest.converged & stable


def stiffness(plant: Plant, q: Tensor) -> Tensor:
    """Of the hanging arm (R, n, n)."""
    slope = load_stiffness(plant.dynamics, q, plant.payload)[1]
    return plant.dynamics.stiffness + 0.5 * (slope + slope.mT)


def slopes(plant: Plant, p: Tensor, q: Tensor) -> Tensor:
    """Derivative of the tip by the pressures, (R, 3, n_a) m/Pa."""
    assert plant.valves is not None
    chambers = plant.valves.chambers
    push = plant.B * (chambers.area * (1.0 + 2.0 * chambers.growth * p)).unsqueeze(-2)
    return plant.backbone.chain(q, plant.dynamics.lengths).tip_jacobian() @ torch.linalg.solve(
        stiffness(plant, q), push
    )


def nearest(plant: Plant, goal: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The tip error (R,) m that is least near pressures p (R, n_a), these pressures, and whether the arm is stable."""
    assert plant.valves is not None
    chambers = plant.valves.chambers
    assert chambers.least is not None and chambers.most is not None
    x, q, good = tips(plant, p, None)
    damping = torch.full_like(p[:, :1, None], 1e-4)
    eye = torch.eye(3, dtype=p.dtype)
    for _ in range(STEPS):
        e, J = goal - x, UNIT * slopes(plant, p, q)
        ahead = (J.mT @ e.unsqueeze(-1)).squeeze(-1)
        held = ((p <= chambers.least) & (ahead < 0.0)) | ((p >= chambers.most) & (ahead > 0.0))
        J = J * (~held).to(J).unsqueeze(-2)
        step = (J.mT @ torch.linalg.solve(J @ J.mT + damping * eye, e.unsqueeze(-1))).squeeze(-1)
        tried = chambers.within(p + UNIT * step.clamp(-0.1, 0.1))
        x_tried, q_tried, rests = tips(plant, tried, q)
        better = rests & ((goal - x_tried).norm(dim=-1) < e.norm(dim=-1))
        keep = better.unsqueeze(-1)
        p, x, q = (torch.where(keep, new, old) for new, old in ((tried, p), (x_tried, x), (q_tried, q)))
        good = good | better
        damping = torch.where(better[:, None, None], 0.2 * damping, 5.0 * damping).clamp(1e-12, 1e3)
    return torch.where(good, (goal - x).norm(dim=-1), torch.inf), p, good


def main() -> None:
    """Prints a line a set-point and payload."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="soft_trunk", help="its name or file (default: %(default)s)")
    options = parser.parse_args()
    config = compose("experiment=dynamic_run_2_tuned", f"arm={options.arm}").settings
    points = torch.tensor(config.experiment.setpoints).double()
    payloads = torch.tensor(config.experiment.payloads).double()
    goal, load = points.repeat_interleave(len(payloads), 0), payloads.repeat(len(points))
    every = load.repeat(STARTS)
    plant = Plant.on(config.arm, every, config.plant)
    assert plant.valves is not None, "the arm has no chambers"
    least, most = plant.valves.chambers.least, plant.valves.chambers.most
    assert least is not None and most is not None
    draws = torch.rand(len(every), len(least), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    draws[: len(goal)] = 0.2
    with torch.no_grad():
        error, p, _ = nearest(plant, goal.repeat(STARTS, 1), torch.lerp(least, most, 0.6 * draws))
    error, p = error.unflatten(0, (STARTS, -1)), p.unflatten(0, (STARTS, -1))
    spare = torch.minimum(p - least, most - p).amin(-1)
    # Of those that reach the point, the one that is farthest from a limit.
    best = torch.where(error < 1e-6, -spare, torch.where(error == torch.inf, torch.inf, UNIT + error)).argmin(0)
    print("| set-point, m | payload, kg | least tip error, mm | pressures, kPa | from a limit, kPa |")
    print("|---|---|---|---|---|")
    for k, (at, kg) in enumerate(zip(goal.tolist(), load.tolist(), strict=True)):
        i = int(best[k])
        told = ", ".join(f"{value:.1f}" for value in (p[i, k] / 1e3).tolist())
        place = ", ".join(f"{value:.3f}" for value in at)
        print(f"| {place} | {kg:.3f} | {1e3 * float(error[i, k]):.4f} | {told} | {float(spare[i, k]) / 1e3:.1f} |")


if __name__ == "__main__":
    main()
