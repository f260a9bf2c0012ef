"""Throughput of the environments: `python benchmarks/environments.py` prints the table and saves environments.json.

A step is one control period of one arm: 10 ms of simulated time, observation, reward and autoreset included. Each row
is the median of single steps of the whole batch, actions drawn before; "cpu us" is processor time of all threads, for
one arm's step. Compare rows of one run, for machines are noisy. Machine code is built once, a minute for a dynamic arm,
and kept.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import time

import gymnasium
import torch
from timing import finished, timed

import apcc_torch
import apcc_torch.envs
from apcc_torch.files import write_json
from apcc_torch.native.compiled import MODES

gymnasium.register_envs(apcc_torch.envs)

ACTIONS = ("configuration_velocity", "task_velocity", "tendon_lengths", "adaptation")
DRAWN = {"lengths": (0.9, 1.1), "stiffness": (0.8, 1.2), "noise": (0.0, 1e-3), "delay": (0, 3)}


def measure(name: str, rows: int, budget: float, settings: dict[str, object]) -> dict[str, float]:
    """Median time of a step, s, and steps of single arms a second, over about `budget` seconds."""
    started = time.perf_counter()
    envs = gymnasium.make_vec(name, num_envs=rows, **settings)  # builds machine code, where asked to
    device = torch.device(str(settings["device"]))
    envs.reset(seed=0)
    size = envs.single_action_space.shape[0]
    actions = [2.0 * torch.rand(rows, size, device=device) - 1.0 for _ in range(8)]

    envs.step(actions[0])  # torch compiles here
    finished(str(device))
    first = time.perf_counter() - started
    turn = itertools.cycle(actions)
    times = timed(lambda: envs.step(next(turn)), budget, device=str(device))
    median = 1e-6 * times["median_us"]
    return {
        "median_ms": 1e3 * median,
        "steps_per_s": rows / median,
        "cpu_us_a_step": times["cpu_us"] / rows,
        "first_s": first,
        "calls": times["calls"],
    }


def jobs(options: argparse.Namespace) -> dict[str, tuple[str, dict[str, object]]]:
    """Every row of the table: name -> id and settings."""
    found: dict[str, tuple[str, dict[str, object]]] = {}
    for dynamics in ("kinematic", "dynamic"):
        for action in ACTIONS:
            found[f"reach_{dynamics}_{action}"] = ("apcc/Reach-v0", {"dynamics": dynamics, "action": action})
        for task in ("Track", "Shape"):
            found[f"{task.lower()}_{dynamics}"] = (f"apcc/{task}-v0", {"dynamics": dynamics})
        found[f"reach_{dynamics}_all_drawn"] = ("apcc/Reach-v0", {"dynamics": dynamics, **DRAWN})
        found[f"reach_{dynamics}_float64"] = ("apcc/Reach-v0", {"dynamics": dynamics, "dtype": "float64"})
    found = {
        f"{name}_{mode}": (task, {**given, "compile": mode})
        for name, (task, given) in found.items()
        for mode in options.compile
    }
    return {name: job for name, job in found.items() if options.only in name}


def main() -> None:
    """Runs the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="environments.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--rows", type=int, default=4096, help="arms side by side (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="time a row (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="torch threads (default: %(default)s)")
    parser.add_argument("--compile", nargs="+", default=["off", "aot"], choices=MODES,
                        help="how the steps are run, each in turn (default: off aot)")  # fmt: skip
    parser.add_argument("--only", default="", help="only rows whose name holds this")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", default=device, help="a torch device (default here: %(default)s)")
    options = parser.parse_args()
    if options.device != "cpu":
        options.compile = [mode for mode in options.compile if mode != "aot"]
    torch.set_num_threads(options.threads)
    results: dict[str, object] = {}
    print(f"{options.rows} arms, float32, {options.device}, {options.threads} threads")
    print(f"{'row':<46}{'median ms':>12}{'steps/s':>14}{'cpu us':>10}")
    for name, (task, given) in jobs(options).items():
        found = measure(task, options.rows, options.seconds, {"dtype": "float32", "device": options.device, **given})
        results[name] = found
        print(f"{name:<46}{found['median_ms']:>12.2f}{found['steps_per_s']:>14.3g}{found['cpu_us_a_step']:>10.2f}",
              flush=True)  # fmt: skip
    results["machine"] = {
        "processor": platform.processor() or platform.machine(),
        "device": torch.cuda.get_device_name() if options.device.startswith("cuda") else "cpu",
        "cpus": os.cpu_count(),
        "threads": options.threads,
        "rows": options.rows,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "apcc_torch": apcc_torch.__version__,
        "load": os.getloadavg()[0],
    }
    write_json(options.out, results)
    print(f"saved {options.out}")


if __name__ == "__main__":
    main()
