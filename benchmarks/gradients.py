"""What a gradient through a closed loop costs: `python benchmarks/gradients.py [--loop dynamic] [--periods 100]`.

Prints time and memory of a run without gradients, and of a run and its gradient by K and Gamma with the fixed point's
implicit derivative, through every iteration, and with checkpoints. All ways take turns and each keeps its fastest time;
memory is the largest of a process of its own. The loop is section V-A's, or the dynamic one of section V-B.
`--machine-code` times forward dynamics and their gradient in place of a loop.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from math import pi
from multiprocessing import get_context

import torch
from subjects import dynamics, plant, states
from timing import timed
from torch import Tensor

from apcc_torch import AdaptiveLaw, APCCController, InverseKinematics, PCCBackbone, SavitzkyGolay, StateFeedback
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.tendons import rack_routing
from apcc_torch.native import DifferentiableFunction
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.kinematic import KinematicLog, simulate_feedback
from apcc_torch.simulation.sensors import PoseSensors

D = torch.float64
TRUE = torch.tensor([0.105, 0.255, 0.240], dtype=D)
GUESS = torch.tensor([0.120, 0.280, 0.270], dtype=D)
SENSORS = torch.tensor([0.105, 0.36, 0.60], dtype=D)
PATH = SineTrajectory(torch.tensor([0.0, 0.0, -0.5], dtype=D), torch.tensor([0.5, 0.3, 0.1], dtype=D), 0.2 * pi)
RATE = 100.0
WAYS = {
    "no gradient": ("implicit", False),
    "implicit": ("implicit", False),
    "unrolled": ("unrolled", False),
    "implicit, checkpointed": ("implicit", True),
    "unrolled, checkpointed": ("unrolled", True),
}


def run(loop: str, gains: tuple[Tensor, Tensor], way: str, periods: int, rows: int) -> KinematicLog | DynamicLog:
    """One run of a loop."""
    gradient, checkpointed = WAYS[way]
    K, gamma = gains
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=D))
    controller = APCCController(
        backbone,
        StateFeedback(backbone, SENSORS, gradient=gradient),
        SavitzkyGolay(15, 2),
        InverseKinematics(K, null_gain=1.0),
        AdaptiveLaw(3, gamma, normalisation=10.0),
        bounds=LengthBounds(TRUE, SENSORS, lower=None, upper=None, reach="last"),
        routing=rack_routing(SENSORS) if loop == "dynamic" else None,
    )
    start = GUESS.expand(rows, 3)
    if loop == "dynamic":
        settings = DynamicSettings(duration=(periods - 1) / RATE, control_rate=RATE, checkpointed=checkpointed)
        return simulate_dynamic(plant(rows), controller, PoseSensors(), PATH, start, settings)
    return simulate_feedback(controller, TRUE, start, PATH, (periods - 1) / RATE, RATE, checkpointed=checkpointed)


def seconds(loop: str, way: str, periods: int, rows: int) -> float:
    """Time of one run, with its gradient if the way has one."""
    gains = (torch.tensor(1.0, dtype=D), torch.tensor([90.0, 42.5, 35.0], dtype=D))
    started = time.perf_counter()
    if way == "no gradient":
        with torch.no_grad():
            run(loop, gains, way, periods, rows)
        return time.perf_counter() - started
    for gain in gains:
        gain.requires_grad_()
    log = run(loop, gains, way, periods, rows)
    loss = (log.x_d - log.x).square().sum() + (log.pi_hat - TRUE).square().sum()
    torch.autograd.grad(loss, gains)
    return time.perf_counter() - started


def in_machine_code(rows: int) -> None:
    """Prints what forward dynamics of six sections and their gradient take, by torch and in machine code."""
    module, given = dynamics(6, D), states(6, rows, D)
    example = tuple(value[0] for value in given) if rows > 1 else given
    fast = DifferentiableFunction(module, example)
    weight = torch.ones_like(module(*given))

    def gradient(function: Callable[..., Tensor]) -> None:
        leaves = [value.clone().requires_grad_() for value in given]
        torch.autograd.grad(function(*leaves), leaves, weight)

    for name, function in (("torch", module), ("machine code", fast)):
        with torch.no_grad():
            alone = timed(lambda f=function: f(*given), 1.0)["median_us"]
        whole = timed(lambda f=function: gradient(f), 2.0)["median_us"]
        print(f"{rows} rows, {name:14s} dynamics {alone:10.1f} us, with their gradient {whole:10.1f} us")


def peak(loop: str, way: str, periods: int, rows: int) -> float:
    """By how much one run raises this process's largest resident memory, MiB: for a process of its own."""
    torch.set_num_threads(1)
    seconds(loop, way, 4, 1)  # what is loaded at the first gradient is not the run's
    before, _, after = (resident(), seconds(loop, way, periods, rows), resident())
    return after - before


def resident() -> float:
    """The largest resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", choices=("kinematic", "dynamic"), default="kinematic")
    parser.add_argument(
        "--ways", nargs="+", choices=list(WAYS), default=list(WAYS), metavar="WAY", help=", ".join(WAYS)
    )
    parser.add_argument("--periods", type=int, default=100)
    parser.add_argument("--rows", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--machine-code", action="store_true", help="forward dynamics by torch and in machine code")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.machine_code:
        return in_machine_code(given.rows)
    # First, for a process inherits the largest memory of the one that starts it.
    memory = {}
    for way in given.ways:
        with get_context("spawn").Pool(1) as alone:
            memory[way] = alone.apply(peak, (given.loop, way, given.periods, given.rows))
    times: dict[str, list[float]] = {way: [] for way in given.ways}
    for _ in range(given.repeats):
        for way, found in times.items():
            found.append(seconds(given.loop, way, given.periods, given.rows))
    fastest = {way: min(found) for way, found in times.items()}
    print(f"{given.loop}, {given.periods} periods of {given.rows} rows, best of {given.repeats}")
    first = next(iter(fastest.values()))
    for way, best in fastest.items():
        took, kept = f"{best:8.3f} s  {best / first:5.2f} times the first", memory[way] / given.periods
        print(f"{way:24s} {took}  {memory[way]:8.1f} MiB  {kept:6.3f} a period")
    if {"implicit", "unrolled"} <= set(fastest):
        print(f"implicit / unrolled: {fastest['implicit'] / fastest['unrolled']:.2f}")


if __name__ == "__main__":
    main()
