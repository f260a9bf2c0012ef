"""The speed table: `python benchmarks/run.py` prints it and saves speed.json.

Every row is the median of many calls in one process; ratios are between rows of the same run, for machines are noisy.
Rows at batch 1 use one thread. `floor` gives the scalar operations and the bytes in and out of one row of the same
formulas, as the compiler counts them. Peers are timed beside where they are installed (pip install -e '.[oracle]'):
NumPy, torch's own compilers, SoRoMoX, MuJoCo's cable at equal accuracy, and pytorch-kinematics.
Machine code is built once, which takes a few minutes at the first run, and is kept (APCC_CACHE).
`--quick` leaves out batches of 64 and 256, single precision and torch's own compilers, which take a minute each to
compile, unless `--only` asks for them; the rows that stay have fewer calls.
`--device cuda` times the eager rows on a GPU instead.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from first_step import first_steps
from kinematics import kinematics
from peer_compilers import compilers
from peer_numpy import prepared
from rods import rods
from subjects import SENSORS, closed_loop, dynamics, floor, one_row, plant, shipped, soromox, states, steps
from timing import flush_caches, timed, timed_steps, wait

import apcc_torch
from apcc_torch.files import write_json
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.standing import StandingCall
from apcc_torch.native.structure import flattened, rebuilt

Row = dict[str, float]
D = torch.float64
BATCHES = (1, 64, 4096)
REAL_TIME_STEPS = 100_000
SLOW = ("float32", "batch_64_", "batch_256_", "inductor")
"""In the names of rows that a quick table leaves out."""


class Table:
    """Rows as they come, printed and kept."""

    def __init__(self, only: str | None, quick: bool) -> None:
        self.rows: dict[str, Any] = {}
        self.only, self.quick = only, quick
        print(f"{'row':<50}{'median us':>12}{'p99.9 us':>12}{'us a row':>12}{'rows/s':>14}")

    def wants(self, name: str) -> bool:
        """Whether a row of this name is asked for."""
        if self.only is not None:
            return self.only in name
        return not (self.quick and any(part in name for part in SLOW))

    def add(self, name: str, batch: int, threads: int, job: Callable[[], Row]) -> None:
        """Runs one row's job with so many threads."""
        if not self.wants(name):
            return
        torch.set_num_threads(threads)
        found = job()
        found["us_a_row"] = found["median_us"] / batch
        found["rows_per_s"] = 1e6 / found["us_a_row"]
        found["threads"] = float(threads)
        self.rows[name] = found
        tail = found.get("p999_us", float("nan"))
        print(f"{name:<50}{found['median_us']:>12.1f}{tail:>12.1f}{found['us_a_row']:>12.2f}{found['rows_per_s']:>14.0f}",
              flush=True)  # fmt: skip

    def compare(self, name: str, peer: str, label: str) -> None:
        """How many times as fast a row is as a peer's, both per row."""
        if name in self.rows and peer in self.rows:
            self.rows[name][f"ratio_to_{label}"] = self.rows[peer]["us_a_row"] / self.rows[name]["us_a_row"]


def control_steps(table: Table, options: argparse.Namespace) -> None:
    """The control step, eager and as machine code, and in plain NumPy."""
    for dtype, label in ((D, "float64"), (torch.float32, "float32")):
        for batch in BATCHES:
            name = f"control_step_{label}_batch_{batch}"
            threads = 1 if batch == 1 else options.threads
            if not table.wants(name + "_aot"):
                continue
            count = 400 if batch == 1 else 25
            if options.quick:
                count = 120 if batch == 1 else 8
            c, inputs = steps(batch, dtype, count)
            late = inputs[-max(3, min(count - 20, 200)) :]
            many = max(5 if options.quick else 20, round(options.budget / (3e-3 if batch < 4096 else 0.3)))
            on = [rebuilt(given, (leaf.to(options.device) for leaf in flattened(given))) for given in late]
            eager = c.to(options.device)
            table.add(
                f"{name}_eager", batch, threads, lambda c=eager, g=on, n=many: timed_steps(c, g, n, options.device)
            )
            if options.device != "cpu":
                continue
            step = NativeFunction(c.to("cpu"), one_row(late[0], batch), threads=threads)
            calls, paused = REAL_TIME_STEPS if batch == 1 else 2000 if batch < 4096 else 100, 200
            if options.quick:
                calls, paused = min(calls, 2000), 50
            table.add(f"{name}_aot", batch, threads,
                      lambda s=step, g=late, n=calls: timed_steps(s, g, n) | floor(s))  # fmt: skip
            table.compare(f"{name}_aot", f"{name}_eager", "eager")
            if batch == 1:
                loop = standing(step, late[0])
                table.add(f"{name}_standing", 1, 1, lambda c=loop, n=calls: timed_steps(c, [()], n))
                if f"{name}_standing" in table.rows:
                    median = table.rows[f"{name}_standing"]["median_us"]
                    table.add(f"{name}_standing_only_waits", 1, 1,
                              lambda m=median, n=calls: timed_steps(lambda: wait(m), [()], n))  # fmt: skip
                table.add(f"{name}_standing_after_20_ms", 1, 1, lambda c=loop, n=paused: timed(c, 0.0, n, pause=0.02))
                table.add(f"{name}_standing_flushed", 1, 1,
                          lambda c=loop, n=paused // 2: timed(c, 0.0, n, before=flush_caches))  # fmt: skip
            if batch == 1 and dtype == D:
                routing = c.routing
                assert routing is not None
                numpy_step, given = prepared(inputs, SENSORS, routing.angles.numpy(), float(routing.offsets[0]))
                wrong = max(
                    float((torch.from_numpy(numpy_step.step(*numbers)) - c(*tensors)[1].y).abs().max())
                    for numbers, tensors in zip(given[:60], inputs, strict=False)
                )
                print(f"  NumPy takes the same steps: tendon lengths differ by {wrong:.0e} m")
                table.rows["numpy_difference"] = {"m": wrong}
                table.add("control_step_numpy", 1, 1, lambda s=numpy_step, g=given: timed_steps(s.step, g[60:], 340))
                table.compare(f"{name}_aot", "control_step_numpy", "numpy")


def shape_steps(table: Table, options: argparse.Namespace) -> None:
    """The step of the controller that ships, eager and as machine code."""
    for batch in BATCHES:
        name = f"shape_step_float64_batch_{batch}"
        if not table.wants(name + "_aot"):
            continue
        threads, count = (1, 200) if batch == 1 else (options.threads, 25)
        if options.quick:
            count = 60 if batch == 1 else 8
        c, inputs = steps(batch, D, count, shipped)
        late = inputs[-max(3, min(count - 20, 100)) :]
        many = max(5 if options.quick else 20, round(options.budget / (2e-2 if batch < 4096 else 0.5)))
        table.add(f"{name}_eager", batch, threads, lambda c=c, g=late, n=many: timed_steps(c, g, n))
        step = NativeFunction(c, one_row(late[0], batch), threads=threads)
        calls = 2000 if batch < 4096 else 100
        table.add(f"{name}_aot", batch, threads, lambda s=step, g=late, n=calls: timed_steps(s, g, n) | floor(s))
        table.compare(f"{name}_aot", f"{name}_eager", "eager")


def standing(step: NativeFunction, given: tuple[Any, ...]) -> Callable[[], None]:
    """A step as the loop in real time makes it: what is new is written into memory that stays."""
    call = StandingCall(step, given, carries=True)
    T, stamp = given[1].T.numpy(), float(given[1].time)
    ticks = itertools.count(1)

    def once() -> None:
        measurement, target = call.given[1:]
        measurement.T[...] = T
        measurement.time[...] = stamp + 0.004 * next(ticks)
        target.x_d[...], target.xdot_d[...] = T[-1, :3, 3], 0.0
        call()

    return once


def forward_dynamics(table: Table, options: argparse.Namespace) -> None:
    """Six sections, beside SoRoMoX."""
    arm = dynamics(6, D)
    wanted = table.wants("forward_dynamics_batch_4096_soromox") or table.wants("rollout_second_soromox_1_row")
    peer = soromox(arm) if wanted and options.device == "cpu" else None
    if peer is not None:
        q, qdot, tau = states(6, 8, D)
        wrong = float((peer.acceleration(q, qdot) - arm(q, qdot, tau)).abs().max() / arm(q, qdot, tau).abs().max())
        print(f"  SoRoMoX has the same arm: accelerations differ by {wrong:.0e} of the largest")
        table.rows["soromox_difference"] = {"relative": wrong}
    for batch in (1, 256, 4096):
        threads = 1 if batch == 1 else options.threads
        given = states(6, batch, D)
        name = f"forward_dynamics_batch_{batch}"
        if not any(table.wants(f"{name}_{kind}") for kind in ("eager", "aot", "soromox")):
            continue
        on = tuple(value.to(options.device) for value in given)
        eager = dynamics(6, D).to(options.device)
        table.add(
            f"{name}_eager",
            batch,
            threads,
            lambda a=eager, g=on: timed(lambda: a(*g), options.budget, device=options.device),
        )
        if options.device != "cpu":
            continue
        step = NativeFunction(arm, tuple(value[0] for value in given) if batch > 1 else given, threads=threads)
        table.add(f"{name}_aot", batch, threads,
                  lambda s=step, g=given: timed(lambda: s(*g), options.budget) | floor(s))  # fmt: skip
        table.compare(f"{name}_aot", f"{name}_eager", "eager")
        if peer is not None:
            call = peer.forward(given[0], given[1])
            table.add(f"{name}_soromox", batch, threads, lambda c=call: timed(c, options.budget))
            table.compare(f"{name}_aot", f"{name}_soromox", "soromox")
            table.compare(f"{name}_eager", f"{name}_soromox", "soromox")
    if peer is not None:
        # A fixed step of 0.5 ms: without tendons; the loop that it is compared with is closed, and stiffer.
        q, qdot, _ = states(6, 1, D)
        call = peer.rollout(0.0 * q, 0.0 * qdot, 1.0, 5e-4)
        table.add("rollout_second_soromox_1_row", 1, 1, lambda: timed(call, options.budget, least=3))


def loops(table: Table, options: argparse.Namespace) -> None:
    """Section V-B's loop, closed and open."""
    few = 0.1 if options.quick else 0.5  # s, where one takes a minute eagerly
    for rows in (1, 60, 4096):
        for mode in ("off", "aot"):
            seconds = 10.0 if mode == "aot" and rows < 4096 else few if rows == 4096 else 0.5
            name = f"closed_loop_{rows}_rows_{'eager' if mode == 'off' else mode}"

            def second(rows: int = rows, seconds: float = seconds, mode: str = mode) -> Row:
                closed_loop(rows, 0.05, mode)
                started = time.perf_counter()
                closed_loop(rows, seconds, mode)
                took = time.perf_counter() - started
                return {"median_us": 1e6 * took / seconds, "seconds_for_10_s": 10.0 * took / seconds}

            table.add(name, rows, 1 if rows == 1 else options.threads, second)
        table.compare(f"closed_loop_{rows}_rows_aot", f"closed_loop_{rows}_rows_eager", "eager")
        table.compare(f"closed_loop_{rows}_rows_aot", "rollout_second_soromox_1_row", "soromox_open_loop")
    for rows in (1, 4096):
        for mode in ("off", "aot"):
            seconds = 10.0 if mode == "aot" and rows == 1 else few if rows == 4096 else 0.5
            arm = plant(rows)

            def hanging(arm: Any = arm, seconds: float = seconds, mode: str = mode) -> Row:
                arm.settled(0.01, 0.005, mode)
                started = time.perf_counter()
                arm.settled(seconds, 0.005, mode)
                return {"median_us": 1e6 * (time.perf_counter() - started) / seconds}

            name = f"open_loop_{rows}_rows_{'eager' if mode == 'off' else mode}"
            table.add(name, rows, 1 if rows == 1 else options.threads, hanging)
        table.compare(f"open_loop_{rows}_rows_aot", f"open_loop_{rows}_rows_eager", "eager")
        table.compare(f"open_loop_{rows}_rows_aot", "rollout_second_soromox_1_row", "soromox_open_loop")


def scaling(table: Table, options: argparse.Namespace) -> None:
    """How cost grows with the sections."""
    for n in (2, 4, 8, 16, 32):
        arm, given = dynamics(n, D).to(options.device), tuple(v.to(options.device) for v in states(n, 256, D))
        table.add(f"forward_dynamics_{n}_sections_batch_256_eager", 256, 1,
                  lambda a=arm, g=given: timed(lambda: a(*g), options.budget, device=options.device))  # fmt: skip


COLD = """
import time; begin = time.perf_counter()
import torch; loaded = time.perf_counter()
import apcc_torch
apcc_torch.PCCBackbone(3).tip(torch.zeros(9), torch.ones(3))
end = time.perf_counter()
print(1e6 * (end - begin), 1e6 * (end - loaded))
"""


def cold_start() -> Row:
    """From nothing to the first tip, in processes of their own; `without_torch_us` leaves torch's own import out."""
    runs = []
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", COLD], capture_output=True, text=True, check=True)
        runs.append([float(v) for v in done.stdout.split()])
    whole, rest = (sorted(column)[len(column) // 2] for column in zip(*runs, strict=True))
    return {"median_us": whole, "without_torch_us": rest}


def main() -> None:
    """Runs the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="speed.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="fewer rows, each in a fifth of the time")
    parser.add_argument("--only", help="only rows whose name holds this")
    parser.add_argument("--device", default="cpu", help="of the eager rows (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1,
                        help="for batches above 1 (default: all, %(default)s)")  # fmt: skip
    options = parser.parse_args()
    options.budget = 0.4 if options.quick else 2.0
    table = Table(options.only, options.quick)
    with torch.no_grad():
        table.add("cold_start", 1, 1, cold_start)
        control_steps(table, options)
        if options.device == "cpu":
            compilers(table, options)
            shape_steps(table, options)
        forward_dynamics(table, options)
        scaling(table, options)
        if options.device == "cpu":
            rods(table, options)
            kinematics(table, options)
            first_steps(table, options)
            loops(table, options)
    table.rows["machine"] = {
        "processor": processor(),
        "cpus": os.cpu_count(),
        "device": torch.cuda.get_device_name() if options.device.startswith("cuda") else "cpu",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "apcc_torch": apcc_torch.__version__,
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "load": os.getloadavg()[0],
    }
    write_json(options.out, table.rows)
    print(f"saved {options.out}")


def processor() -> str:
    """What the machine calls its processor."""
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
