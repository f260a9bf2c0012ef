"""How long the first step in machine code takes: `python benchmarks/first_step.py [SUBJECT ...] [--repeats 3]`.

Each subject is taken three times: its structure is new (nothing is kept, so it is traced, written and compiled); its
structure is known from another arm, in a fresh process; and once more in the same process. From the description of the
arm to the result of the first step, without the import of torch and of this package. Every arm has other lengths, mass,
stiffness and gains. Medians of several fresh processes, with the least and the largest; machines are noisy.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import torch
from subjects import LENGTHS, SENSORS

import apcc_torch.envs
from apcc_torch import APCCController, Arm, Measurement, Target, decouple
from apcc_torch.control import LookaheadSettings
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.native.compiled import compiled
from apcc_torch.simulation.dynamic import ClosedLoop
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.sensors import PoseSensors

gymnasium.register_envs(apcc_torch.envs)
D = torch.float64
AIM = torch.tensor([0.2, 0.05, -0.5], dtype=D)


def arm(number: int) -> Arm:
    """The paper's arm, and others of its structure."""
    scale = 1.0 + 0.037 * number
    lengths = [scale * length for length in LENGTHS]
    sensors = [scale * place for place in SENSORS]
    return Arm(lengths=lengths, sensors=sensors, mass=0.4 * scale, bending_stiffness=0.8 * scale)


def controller(number: int) -> APCCController:
    """That which ships for the arm."""
    return APCCController.for_arm(arm(number), K=1.8 + 0.1 * number, elongation_bound=0.08)


def control_step(number: int) -> object:
    """The controller's step, of one row."""
    c, L0, q = controller(number), arm(number).rest_lengths(), torch.zeros(9, dtype=D)
    T = c.backbone.pose(q, L0, *decouple(arm(number).sensor_places(), L0))
    given = c.initial_state(q, 1.1 * L0), Measurement(T, torch.zeros((), dtype=D)), Target(AIM, torch.zeros_like(AIM))
    return compiled(c, given, "aot")(*given)


def closed_loop(number: int) -> object:
    """A period of controller, sensors and dynamic arm, of 64 rows."""
    plant = Plant.on(arm(number), torch.linspace(0.0, 0.3, 64, dtype=D), PlantSettings())
    loop = ClosedLoop(plant, controller(number), PoseSensors(), SetPoint(AIM.expand(64, 3)), 0.01)
    given = loop.blank()
    return compiled(loop, given, "aot", 64, carries=True)(*given)


def settling(number: int) -> object:
    """A step of the dynamic arm that comes to rest before a simulation, of 64 rows."""
    plant = Plant.on(arm(number), torch.linspace(0.0, 0.3, 64, dtype=D), PlantSettings())
    return plant.settled(plant.settle, 0.005, "aot")


def stepped(number: int, **settings: Any) -> object:
    """Reset and step of 64 arms."""
    envs: Any = gymnasium.make_vec("apcc/Reach-v0", num_envs=64, arm=arm(number), compile="aot", **settings)
    envs.reset(seed=0)
    return envs.step(torch.zeros(64, envs.single_action_space.shape[0]))


def kinematic_environment(number: int) -> object:
    """Of kinematic arms."""
    return stepped(number)


def environment(number: int) -> object:
    """Of dynamic arms."""
    return stepped(number, dynamics="dynamic")


def environment_ahead(number: int) -> object:
    """Of dynamic arms whose controllers look ahead."""
    control = {"lookahead": LookaheadSettings(samples=64)}
    return stepped(number, dynamics="dynamic", action="adaptation", control=control)


SUBJECTS: dict[str, Callable[[int], object]] = {
    "control step": control_step,
    "closed loop": closed_loop,
    "settling": settling,
    "kinematic environment": kinematic_environment,
    "environment": environment,
    "environment ahead": environment_ahead,
}


def seconds(subject: str, *numbers: int) -> list[float]:
    """Times of the first step of these arms, one after the other, s."""
    times = []
    for number in numbers:
        started = time.perf_counter()
        SUBJECTS[subject](number)
        times.append(time.perf_counter() - started)
    return times


def in_a_process(cache: str, subject: str, *numbers: int) -> list[float]:
    """The same in a fresh process, with machine code kept in a folder."""
    command = [sys.executable, __file__, "--arms", *map(str, numbers), "--", subject]
    environment = os.environ | {"APCC_CACHE": cache}
    told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
    times: list[float] = json.loads(told)
    return times


class FirstStep(NamedTuple):
    """Times of the three cases, s, and the size of the largest library that was built, kB."""

    new: float
    known: float
    again: float
    library: float


def measured(subject: str) -> FirstStep:
    """A subject, once."""
    with tempfile.TemporaryDirectory() as folder:
        (new,) = in_a_process(folder, subject, 0)
        known, again = in_a_process(folder, subject, 1, 2)
        library = max(file.stat().st_size for file in Path(folder).rglob("*.so"))
    return FirstStep(new, known, again, 1e-3 * library)


def first_steps(table: Any, options: argparse.Namespace) -> None:
    """Rows of the speed table; a quick one has the control step alone."""
    for subject in list(SUBJECTS)[: 1 if options.quick else None]:
        name = f"first_step_{subject.replace(' ', '_')}"
        if not any(table.wants(f"{name}_{case}") for case in FirstStep._fields[:3]):
            continue
        *times, library = measured(subject)
        table.rows[f"{name}_library"] = {"kB": library}
        for case, took in zip(FirstStep._fields, times, strict=False):
            table.add(f"{name}_{case}", 1, 1, lambda s=took: {"median_us": 1e6 * s})


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", default=list(SUBJECTS), help=", ".join(SUBJECTS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--arms", nargs="*", type=int, help="print the times of these arms in this process as JSON")
    given = parser.parse_args()
    if given.arms is not None:
        print(json.dumps(seconds(given.subjects[0], *given.arms)))
        return
    print(f"{'first step':<24}{'case':<12}{'median':>10}{'least':>10}{'largest':>10}")
    for subject in given.subjects:
        runs = [measured(subject) for _ in range(given.repeats)]
        for case, unit in zip(FirstStep._fields, ("s", "s", "s", "kB"), strict=True):
            found = [getattr(run, case) for run in runs]
            shown = "".join(f"{value:>10.4g}" for value in (statistics.median(found), min(found), max(found)))
            print(f"{subject:<24}{case:<12}{shown} {unit}", flush=True)


if __name__ == "__main__":
    main()
