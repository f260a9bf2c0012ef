"""Contacts that begin while the arm moves: how soon a signal shows them, at a threshold above that of free motion."""

from __future__ import annotations

from typing import NamedTuple

import torch
from force_cases import CONTROLLERS, NOISE, D, TouchedArm, balance, settings
from torch import Tensor
from tqdm import tqdm

from apcc_torch import SavitzkyGolay
from apcc_torch.composition.build import Builder
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.estimation.momentum_observer import MomentumObserver
from apcc_torch.estimation.posture import Posture
from apcc_torch.native.compiled import compiled
from apcc_torch.simulation.dynamic import ClosedLoop, DynamicLog
from apcc_torch.simulation.plant import Plant

DT = 0.01
BEGINS, ENDS = 2.0, 4.0  # s; at 2 s the tip still moves
SETTLED = 0.5  # s; from then on signals count
SIZES = (0.5, 1.0, 2.0)
SECTION = 3
"""The contact is at the tip of the true arm's fourth section, 0.36 m from the base."""
REPEATS = 4  # runs to each set-point, with contacts in other directions
Q_BAR, U = (DynamicLog._fields.index(name) - 1 for name in ("q_bar", "u"))  # a period's row has no time
MEMORY = 50  # samples; a change is against the signal so long ago


class Motion(NamedTuple):
    """A run, time first.

    q_bar: (T, R, 9). u: (T, R, 9) N, with the tension sensors' noise. size: (R,) of the contact, N.
    training: (R,) bool, on the way to an even set-point.
    """

    q_bar: Tensor
    u: Tensor
    size: Tensor
    training: Tensor


def run(compile: str) -> Motion:
    """To all set-points, free and touched from `BEGINS` on."""
    config = settings(*CONTROLLERS["fixed"], "experiment.payloads=[0.0]")
    build = Builder(config)
    generator = torch.Generator().manual_seed(5)
    sizes = torch.tensor((0.0, *SIZES), dtype=D)
    points = build.setpoints()
    rows = points.repeat_interleave(REPEATS * len(sizes), dim=0)
    training = (torch.arange(len(points)) % 2 == 0).repeat_interleave(REPEATS * len(sizes))
    size = sizes.repeat(REPEATS * len(points))
    direction = torch.randn(REPEATS * len(points), 3, dtype=D, generator=generator)
    direction = (direction / direction.norm(dim=-1, keepdim=True)).repeat_interleave(len(sizes), dim=0)
    touch = torch.zeros(len(rows), 6, 6, dtype=D)
    free = touch.clone()
    touch[:, SECTION, 3:] = size.unsqueeze(-1) * direction
    p = config.plant

    def loop(forces: Tensor) -> ClosedLoop:
        plant = build.plant(torch.zeros(len(rows), dtype=D))
        touched = Plant(TouchedArm(plant.dynamics, forces), plant.routing, plant.pid, plant.payload, p)
        return ClosedLoop(touched, build.controller(), build.pose_sensors(), SetPoint(rows), DT)

    loops = [loop(free), loop(touch)]
    steps = [compiled(one, one.blank(), compile, len(rows)) for one in loops]
    arm = loops[0].plant.settled(p.settle, DT / p.substeps, compile)
    now = loops[0].start(arm, build.first_estimate())
    like = torch.zeros((), dtype=D)
    q_bar, u = [], []
    for k in tqdm(range(round(ENDS / DT)), desc="motion"):
        step, one = (steps[k * DT >= BEGINS], loops[0])
        draws = one.sensors.draw(now.sensors.queue[..., 0, :, :, :], generator)
        now, row = step(now, like + k * DT, torch.tensor(k), draws)
        q_bar.append(row[Q_BAR])
        u.append(row[U])
    forces = torch.stack(u)
    noise = NOISE.tension * torch.randn(forces.shape, dtype=D, generator=generator)
    return Motion(torch.stack(q_bar), forces + noise, size, training)


def signals(motion: Motion) -> dict[str, Tensor]:
    """Generalized forces (T, R, 9) that show a contact: the balance at rest, and the momentum observer's r."""
    build = Builder(settings(*CONTROLLERS["fixed"]))
    pi, arm = build.rest_lengths(), build.arm.dynamics()
    observer = MomentumObserver(arm, build.routing(), gain=10.0, tendon_damping=build.config.plant.tendon_damping)
    b = balance(build, build.backbone())
    velocity_filter = SavitzkyGolay(15, 2)
    T, R, _ = motion.q_bar.shape
    memory = velocity_filter.initial_state(motion.q_bar[0], torch.zeros(R, dtype=D))
    state = observer.initial_state(motion.q_bar[0])
    found: dict[str, list[Tensor]] = {"balance": [], "momentum observer": []}
    for k in range(T):
        q, u = motion.q_bar[k], motion.u[k]
        memory, qdot = velocity_filter(memory, q, torch.full((R,), k * DT, dtype=D))
        state = observer(state, q, qdot, u, DT)
        found["momentum observer"].append(state.r)
        found["balance"].append(b.imbalance(Posture(q, pi.expand(R, 3), u)))
    whole = {name: torch.stack(rows) for name, rows in found.items()}
    changes = {f"{name}, change in {MEMORY * DT:g} s": v[MEMORY:] - v[:-MEMORY] for name, v in whole.items()}
    padded = {name: torch.nn.functional.pad(v, (0, 0, 0, 0, MEMORY, 0)) for name, v in changes.items()}
    return whole | padded


def detections(compile: str) -> dict[str, dict[str, dict[str, float]]]:
    """Share seen and time until then, per signal and size of the contact.

    A signal's offset, spread and threshold, its largest value, come from free motion to the even set-points; contacts
    and false alarms are those on the way to the odd ones. What alarmed before the contact has not seen it.
    """
    motion = run(compile)
    free = motion.size == 0.0
    training, other = free & motion.training, free & ~motion.training
    begins, first = round(BEGINS / DT), round(SETTLED / DT) + MEMORY
    results: dict[str, dict[str, dict[str, float]]] = {}
    for name, r in signals(motion).items():
        known = r[first:, training].flatten(0, 1)
        offset = known.mean(0)
        S = (known - offset).mT @ (known - offset) / len(known)
        apart = r - offset
        size = (apart * torch.linalg.solve(S, apart.unsqueeze(-1)).squeeze(-1)).sum(-1)
        threshold = size[first:, training].max()
        alarms = (size[first:, other] > threshold).any(0).double().mean()
        for force in SIZES:
            above = size[first:, (motion.size == force) & ~motion.training] > threshold
            quiet, above = ~above[: begins - first].any(0), above[begins - first :]
            seen = above.any(0) & quiet
            after = DT * above.to(torch.int64).argmax(0)[seen].double()
            results.setdefault(name, {})[f"{force:g}"] = {
                "seen": float(seen.double().mean()),
                "median_s": float(after.median()) if len(after) else float("nan"),
                "longest_s": float(after.max()) if len(after) else float("nan"),
                "alarms": float(alarms),
            }
    return results
