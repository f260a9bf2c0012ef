"""How close an arm's MJCF is to the arm: `python benchmarks/model_files.py`, a minute; it needs mujoco.

The tip at rest in MuJoCo beside that of the arm's own statics in twelve parts a section: under its weight, with a force
at the tip, and with tensions, over the number of elements of a section, with what a step of MuJoCo takes.
"""

from __future__ import annotations

import argparse
import time

import mujoco
import numpy as np
import torch
from mujoco_rest import AtRest

from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.link_chain import ChainSettings, LinkChain
from apcc_torch.model.loads import Loads
from apcc_torch.model.mjcf import mjcf_text
from apcc_torch.model.statics import equilibrium

ARMS = ("arm_1", "arm_2", "trunk")
ELEMENTS = (2, 4, 6, 8, 12)
FINE = 12
FORCE = (0.3, -0.2, 0.1)
"""N, at the tip."""
MOST = 3.0
"""Largest tension, N."""
STEPS = 500


def cases(arm: Arm) -> tuple[tuple[dict, dict], ...]:
    """What the arm's statics and MuJoCo's are told, three times."""
    wrench = torch.tensor((0.0, 0.0, 0.0, *FORCE), dtype=torch.float64)
    tensions = MOST * torch.rand(arm.n_tendons, generator=torch.Generator().manual_seed(0)).double()
    pulled = {"routing": arm.routing(), "tensions": tensions}
    return ({}, {}), ({"loads": Loads(wrench)}, {"force": FORCE}), (pulled, {"tensions": tensions.tolist()})


def tip(arm: Arm, told: dict) -> np.ndarray:
    """The tip (3,) by the arm's own statics, m."""
    found = equilibrium(arm.dynamics(FINE), **told)
    backbone = PCCBackbone(FINE * arm.n_sections, arm.base_rotation())
    return backbone.tip(found.q, arm.refined(FINE)).numpy()


def step_time(model: mujoco.MjModel) -> float:
    """What a step takes, us."""
    data = mujoco.MjData(model)
    began = time.perf_counter()
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    return 1e6 * (time.perf_counter() - began) / STEPS


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    torch.set_num_threads(1)
    arms = {name: Arm.load(name) for name in ARMS}
    tips = {name: [tip(arm, ours) for ours, _ in cases(arm)] for name, arm in arms.items()}
    print("| elements a section | weight | force at the tip | tensions | a step |\n|---|---|---|---|---|")
    for elements in ELEMENTS:
        off, took = np.zeros(3), []
        for name, arm in arms.items():
            chain = LinkChain(arm, ChainSettings(elements=elements))
            model = mujoco.MjModel.from_xml_string(mjcf_text(chain))
            rests = [AtRest(model, **theirs).data.site("tip").xpos for _, theirs in cases(arm)]
            away = [np.linalg.norm(rest - ours) for rest, ours in zip(rests, tips[name], strict=True)]
            off = np.maximum(off, 100.0 * np.array(away) / chain.length)
            took.append(step_time(model))
        print(f"| {elements} | {' | '.join(f'{value:.2f} %' for value in off)} | {np.mean(took):.0f} µs |")


if __name__ == "__main__":
    main()
