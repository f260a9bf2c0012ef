"""The speed table: `python benchmarks/run.py` prints it and saves speed.json.

Every row is the median of many calls in this process; compare rows of one run, for machines are noisy. Rows at batch 1
use one thread. With glibc, MALLOC_TRIM_THRESHOLD_=1000000000 and MALLOC_MMAP_THRESHOLD_=1000000000 in the environment
avoid page faults at large batches; the file says whether they were set.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from math import pi

import torch
from torch import Tensor

import apcc_torch
from apcc_torch import (
    AdaptiveLaw,
    APCCController,
    InverseKinematics,
    Measurement,
    PCCBackbone,
    SavitzkyGolay,
    SoftArmDynamics,
    StateFeedback,
    decouple,
)
from apcc_torch.control.pid import TendonPID, TendonReference
from apcc_torch.control.signals import ControllerState
from apcc_torch.files import write_json
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.integrators import ArmState
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from apcc_torch.simulation.dynamic import DynamicSettings, simulate_dynamic
from apcc_torch.simulation.kinematic import start_configuration
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.simulation.trajectory import SetPoint, SineTrajectory

LENGTHS = (0.105, 0.255, 0.24)
SENSORS = (0.105, 0.36, 0.6)
PLANT = (0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12)
RATE = 250.0


def timed(call: Callable[[], object], budget: float) -> dict[str, float]:
    """Median, 99.9th percentile and spread of a call, in microseconds, over about `budget` seconds."""
    call()
    samples: list[float] = []
    end = time.perf_counter() + budget
    while len(samples) < 5 or time.perf_counter() < end:
        started = time.perf_counter()
        call()
        samples.append(1e6 * (time.perf_counter() - started))
    samples.sort()
    last = len(samples) - 1
    return {
        "median_us": statistics.median(samples),
        "p999_us": samples[round(0.999 * last)],
        "min_us": samples[0],
        "calls": float(len(samples)),
    }


def controller(dtype: torch.dtype, routed: bool = False) -> APCCController:
    """The A-PCC controller with poses and the estimator-aware law."""
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=dtype))
    sensors = torch.tensor(SENSORS, dtype=dtype)
    return APCCController(
        backbone,
        StateFeedback(backbone, sensors),
        SavitzkyGolay(15, 2),
        InverseKinematics(1.8 if routed else 1.0, null_gain=0.2),
        AdaptiveLaw(3, 1.0, reach=0.6, normalisation=10.0),
        routing=rack_routing(sensors) if routed else None,
        elongation_bound=0.08 if routed else None,
    )


class Stepping:
    """The controller in the loop of section V-A, so that the estimator has its usual work."""

    def __init__(self, batch: int, dtype: torch.dtype) -> None:
        self.controller = controller(dtype)
        self.pi = torch.tensor(LENGTHS, dtype=dtype)
        self.path = SineTrajectory(
            torch.tensor([0.0, 0.0, -0.5], dtype=dtype), torch.tensor([0.5, 0.3, 0.1], dtype=dtype), 0.2 * pi
        )
        self.k = 0
        start = start_configuration(self.controller.backbone, self.pi, self.path(self.now()).x_d)
        self.q = start.expand(batch, 9) if batch > 1 else start
        first = torch.tensor([0.12, 0.28, 0.27], dtype=dtype)
        self.state: ControllerState = self.controller.initial_state(self.q, first)
        self.places = decouple(torch.tensor(SENSORS, dtype=dtype), self.pi)

    def now(self) -> Tensor:
        """Time of the step, s."""
        return torch.tensor(self.k / RATE, dtype=self.pi.dtype)

    def prepare(self) -> Measurement:
        """What the sensors see now."""
        return Measurement(self.controller.backbone.pose(self.q, self.pi, *self.places), self.now())

    def measure(self, budget: float) -> dict[str, float]:
        """Times the controller alone, sensors and plant left out."""
        samples: list[float] = []
        end = time.perf_counter() + budget
        while len(samples) < 25 or time.perf_counter() < end:
            seen, target = self.prepare(), self.path(self.now())
            started = time.perf_counter()
            self.state, command = self.controller(self.state, seen, target)
            samples.append(1e6 * (time.perf_counter() - started))
            self.q = self.q + command.qdot / RATE
            self.k += 1
        samples = sorted(samples[5:])
        return {
            "median_us": statistics.median(samples),
            "p999_us": samples[round(0.999 * (len(samples) - 1))],
            "min_us": samples[0],
            "calls": float(len(samples)),
        }

    def measure_estimator(self, budget: float) -> dict[str, float]:
        """Times algorithm 2 alone, in the middle of the loop."""
        for _ in range(20):
            self.state, command = self.controller(self.state, self.prepare(), self.path(self.now()))
            self.q = self.q + command.qdot / RATE
            self.k += 1
        seen, state = self.prepare(), self.state
        return timed(lambda: self.controller.feedback(state.q_bar, state.pi_hat, seen.T), budget)


def dynamics(n: int, dtype: torch.dtype) -> SoftArmDynamics:
    """The arm of section V-B with n sections."""
    lengths = torch.tensor(PLANT, dtype=dtype) if n == 6 else torch.full((n,), 0.6 / n, dtype=dtype)
    axial, bending = scaled_stiffness(lengths)
    base = torch.tensor(HANGING, dtype=dtype)
    return SoftArmDynamics(lengths, lengths / lengths.sum(), axial, bending, damping_ratio=0.1, base_rotation=base)


def forward(n: int, batch: int, dtype: torch.dtype, budget: float) -> dict[str, float]:
    """Times the forward dynamics."""
    arm = dynamics(n, dtype)
    generator = torch.Generator().manual_seed(0)
    q = 0.1 * torch.randn(batch, 3 * n, dtype=dtype, generator=generator)
    q[:, 2::3] *= 0.02
    tau = torch.zeros_like(q)
    return timed(lambda: arm(q, q, tau), budget)


def plant_step(batch: int, budget: float) -> dict[str, float]:
    """Times one plant step under the tendon loop."""
    racks = torch.tensor(SENSORS, dtype=torch.float64)
    plant = Plant(
        dynamics(6, torch.float64), rack_routing(racks), TendonPID(), torch.zeros(batch, dtype=torch.float64), 200.0
    )
    zero = torch.zeros(batch, 18, dtype=torch.float64)
    z = torch.zeros(batch, 9, dtype=torch.float64)
    hold = TendonReference(z, z)
    return timed(lambda: plant.step(ArmState(zero, zero), z, hold, 0.005), budget)


def closed_loop(rows: int, duration: float) -> dict[str, float]:
    """Times the whole closed loop of section V-B, settling left out by subtraction."""
    racks = torch.tensor(SENSORS, dtype=torch.float64)
    payload = torch.linspace(0.0, 0.5, rows, dtype=torch.float64)
    plant = Plant(dynamics(6, torch.float64), rack_routing(racks), TendonPID(), payload, 200.0)
    target = SetPoint(torch.tensor([0.215, 0.03, -0.515], dtype=torch.float64).expand(rows, 3))
    first = torch.tensor(LENGTHS, dtype=torch.float64)

    def run(seconds: float) -> float:
        settings = DynamicSettings(seconds, 100.0, 2, 0.2)
        started = time.perf_counter()
        simulate_dynamic(plant, controller(torch.float64, routed=True), PoseSensors(), target, first, settings)
        return time.perf_counter() - started

    run(0.05)
    second = (run(duration + 0.1) - run(0.1)) / duration
    return {"median_us": 1e6 * second, "seconds_for_10_s": 10.0 * second, "rows": float(rows)}


def main() -> None:
    """Runs the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="speed.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a fifth of the time a row, for a first look")
    parser.add_argument(
        "--scaling", action="store_true", help="also how cost grows with sections and batch, and memory"
    )
    parser.add_argument("--full-grid", action="store_true", help="also run 180 rows of the closed loop for all 10 s")
    parser.add_argument(
        "--threads", type=int, default=1, help="torch threads for batches above 1 (default: %(default)s)"
    )
    options = parser.parse_args()
    budget = 0.4 if options.quick else 2.0
    jobs: dict[str, tuple[int, int, Callable[[], dict[str, float]]]] = {}
    for dtype, name in ((torch.float64, "float64"), (torch.float32, "float32")):
        for batch in (1, 64, 4096):
            jobs[f"control_step_{name}_batch_{batch}"] = (
                batch,
                1 if batch == 1 else options.threads,
                lambda batch=batch, dtype=dtype: Stepping(batch, dtype).measure(budget),
            )
            jobs[f"estimator_{name}_batch_{batch}"] = (
                batch,
                1 if batch == 1 else options.threads,
                lambda batch=batch, dtype=dtype: Stepping(batch, dtype).measure_estimator(budget),
            )
    for batch in (1, 256, 4096):
        jobs[f"forward_dynamics_6_sections_batch_{batch}"] = (
            batch,
            1 if batch == 1 else options.threads,
            lambda batch=batch: forward(6, batch, torch.float64, budget),
        )
    jobs["plant_step_batch_60"] = (60, options.threads, lambda: plant_step(60, budget))
    jobs["closed_loop_second_30_rows"] = (30, options.threads, lambda: closed_loop(30, 1.0))
    jobs["closed_loop_second_180_rows"] = (180, options.threads, lambda: closed_loop(180, 1.0))
    if options.full_grid:
        jobs["closed_loop_10_s_180_rows"] = (180, options.threads, lambda: closed_loop(180, 10.0))
    if options.scaling:
        for n in (2, 4, 8, 16, 32):
            jobs[f"forward_dynamics_{n}_sections_batch_256"] = (
                256,
                options.threads,
                lambda n=n: forward(n, 256, torch.float64, budget),
            )
        jobs["closed_loop_second_4096_rows"] = (4096, options.threads, lambda: closed_loop(4096, 0.1))
    results: dict[str, object] = {}
    print(f"{'row':<42}{'median us':>12}{'p99.9 us':>12}{'rows/s':>12}")
    for name, (batch, threads, job) in jobs.items():
        torch.set_num_threads(threads)
        with torch.inference_mode():
            found = job()
        found["rows_per_s"] = 1e6 * batch / found["median_us"]
        found["peak_rss_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        results[name] = found
        tail = found.get("p999_us", float("nan"))
        print(f"{name:<42}{found['median_us']:>12.0f}{tail:>12.0f}{found['rows_per_s']:>12.0f}")
    results["machine"] = {
        "processor": platform.processor() or platform.machine(),
        "cpus": os.cpu_count(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "apcc_torch": apcc_torch.__version__,
        "malloc_settings": {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"} <= os.environ.keys(),
        "load": os.getloadavg()[0],
    }
    write_json(options.out, results)
    print(f"saved {options.out}")


if __name__ == "__main__":
    main()
