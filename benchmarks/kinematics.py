"""Kinematics and algorithm 2 by themselves, eagerly and as machine code: rows of the speed table."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import torch
from peer_rigid_chain import tip_and_jacobian
from subjects import LENGTHS, SENSORS, arm_of, floor, soromox, states
from timing import timed

from apcc_torch import PCCBackbone, StateFeedback, decouple
from apcc_torch.model.backbone import HANGING
from apcc_torch.native import NativeFunction

D = torch.float64
BATCHES = (1, 4096)
ITERATIONS = 5

Subject = tuple[Callable[..., Any], tuple[Any, ...]]
"""What is called, and its arguments."""


def kinematics(table: Any, options: argparse.Namespace) -> None:
    """Every subject at every batch, tip and Jacobian beside others'."""
    _beside(table, options)
    for batch in BATCHES:
        threads = 1 if batch == 1 else options.threads
        for name, (function, given) in subjects(batch).items():
            fast = f"{name}_batch_{batch}_aot"
            table.add(f"{name}_batch_{batch}_eager", batch, threads,
                      lambda f=function, g=given: timed(lambda: f(*g), options.budget))  # fmt: skip
            if not table.wants(fast):
                continue  # without building it
            row = tuple(value[0] if batch > 1 and value.shape[0] == batch else value for value in given)
            step = NativeFunction(function, row, threads=threads)
            table.add(fast, batch, threads,
                      lambda s=step, g=given: timed(lambda: s(*g), options.budget) | floor(s))  # fmt: skip
            for other in ("eager", "rigid_chain", "soromox"):
                table.compare(fast, f"{name}_batch_{batch}_{other}", other)


def _beside(table: Any, options: argparse.Namespace) -> None:
    """Tip and Jacobian by pytorch-kinematics and SoRoMoX."""
    L0 = torch.tensor(LENGTHS, dtype=D)
    peer = soromox(arm_of(L0)) if table.wants("tip_and_jacobian_batch_4096_soromox") else None
    for batch in BATCHES:
        q = states(3, max(batch, 2), D)[0][:batch]
        threads, name = 1 if batch == 1 else options.threads, f"tip_and_jacobian_batch_{batch}"
        chain = tip_and_jacobian(q, L0)
        table.add(f"{name}_rigid_chain", batch, threads, lambda c=chain: timed(c, options.budget))
        if peer is not None:
            call = peer.tip_and_jacobian(q if batch > 1 else q[0])
            table.add(f"{name}_soromox", batch, threads, lambda c=call: timed(c, options.budget))


def subjects(batch: int) -> dict[str, Subject]:
    """The paper's arm: tip and Jacobian, pose of its sensors, regressor, and algorithm 2 of so many iterations."""
    backbone, sensors = PCCBackbone(3, torch.tensor(HANGING, dtype=D)), torch.tensor(SENSORS, dtype=D)
    L0 = torch.tensor(LENGTHS, dtype=D)
    q, qdot, _ = (value[:batch] if batch > 1 else value[0] for value in states(3, max(batch, 2), D))
    places = decouple(sensors, L0)
    estimation = StateFeedback(backbone, sensors, min_iterations=ITERATIONS, max_iterations=ITERATIONS)
    seed = q + 0.05 * qdot
    return {
        "tip_and_jacobian": (backbone.tip_and_jacobian, (q, L0)),
        "sensor_poses": (backbone.pose, (q, L0, *places)),
        "regressor": (backbone.regressor, (q, qdot)),
        "algorithm_2": (estimation, (seed, L0, backbone.pose(q, L0, *places))),
    }
