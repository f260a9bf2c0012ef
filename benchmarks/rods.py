"""One rod as the toolkit's sections and as MuJoCo's cable, at equal accuracy: rows of the speed table."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
from typing import Any

import torch
from timing import timed

from apcc_torch.native import NativeFunction

BATCHES = (1, 4096)


def rods(table: Any, options: argparse.Namespace) -> None:
    """Forward dynamics of as many pieces as each model needs; MuJoCo takes one row at a time."""
    if importlib.util.find_spec("mujoco") is None or not table.wants("rod_dynamics_batch_4096_aot"):
        return
    # Only here, and only where it is installed.
    peer: Any = importlib.import_module("peer_mujoco")
    n, edges = peer.fewest(peer.sections_tip), peer.fewest(peer.cable_tip)
    print(f"  within {100 * peer.ACCURACY:g} % of the rod's length: {n} sections, and a cable of {edges} edges")
    table.rows["rod_pieces"] = {"sections": n, "cable_edges": edges, "accuracy": peer.ACCURACY}
    table.add("rod_dynamics_mujoco_cable", 1, 1, lambda: timed(peer.cable_forward(edges), options.budget))
    arm = peer.sections(n)
    for batch in BATCHES:
        generator = torch.Generator().manual_seed(0)
        q, qdot = (0.01 * torch.randn(batch, 3 * n, dtype=torch.float64, generator=generator) for _ in range(2))
        q[:, 2::3], qdot[:, 2::3] = 0.0, 0.0
        given = (q, qdot, torch.zeros_like(q)) if batch > 1 else (q[0], qdot[0], torch.zeros_like(q[0]))
        row = tuple(value[0] for value in given) if batch > 1 else given
        threads, name = 1 if batch == 1 else options.threads, f"rod_dynamics_batch_{batch}_aot"
        step = NativeFunction(arm, row, threads=threads)
        table.add(name, batch, threads, lambda s=step, g=given: timed(lambda: s(*g), options.budget))
        table.compare(name, "rod_dynamics_mujoco_cable", "mujoco_cable")
