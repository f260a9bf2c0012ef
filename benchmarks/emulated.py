"""The whole runner on the emulated platform: `PYTHONPATH=tests python benchmarks/emulated.py` saves emulated.json.

The real Dynamixel SDK talks to motors on a pseudo terminal, the real NatNet parser to cameras on loopback, each in a
process of its own; in between is an arm that follows the tendons by kinematics. The run tracks a curve, calibrated
first as on the arm. It fails where the overrun budget is spent, or where one exchange with a motor fails. Three
processes need as many free cores: deadlines that a busy machine misses say nothing about the runner.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
from pathlib import Path

from apcc_torch.experiments import arm_calibration, realtime
from apcc_torch.files import write_json
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from apcc_torch.hardware.summary import STAGES
from composed import composed_realtime
from hardware.emulators.rig import EmulatedPlatform

# What the guards are on the arm: 5 missed deadlines in a second end the run.
BUDGET = ("guards.overruns=5", "guards.overrun_window=1.0", "guards.failed_exchanges=5")
CURVE = ("experiment=tracking", "experiment.payloads=[0.0]", "experiment.A=[0.1,0.1,0.03]", "loop.hold=0.0")


def measure(rate: float, seconds: float, folder: Path, more: list[str]) -> dict[str, float | str]:
    """One run at a rate; its metrics, how it ended, and the exchanges that failed."""
    with EmulatedPlatform(folder, rate) as emulated:
        file = folder / "arm.json"
        common = [*emulated.overrides, "view=false", f"calibration.file={file}"]
        outcome, _ = arm_calibration.run(composed_realtime("experiment=calibration", *common), folder)
        if outcome.reason is not StopReason.COMPLETED:
            return {"reason": outcome.reason.value, "message": outcome.message}
        settings = [*CURVE, *common, *BUDGET, f"loop.rate={rate}", f"experiment.duration={seconds}", *more]
        outcome, metrics = realtime.run(composed_realtime(*settings), "", folder)
    log = read_log(folder / "log.mcap")
    failed = sum(event["kind"] == "exchange_failed" for event in log.events)
    replayed = realtime.replay_log(log).difference
    found: dict[str, float | str] = {"reason": outcome.reason.value, "message": outcome.message}
    return found | metrics | {"failed_exchanges": float(failed), "replay_difference_m": replayed}


def main() -> int:
    """Measures once; the exit code is 0 where the run came to its end without a failed exchange."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=100.0, help="of the loop and of the cameras, Hz")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("emulated.json"))
    parser.add_argument("overrides", nargs="*", help="settings of apcc_torch.robot, as key=value")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(arguments.rate, arguments.seconds, Path(folder), arguments.overrides)
    for name in ("reason", "message", "turns", "control_steps", "missed_deadlines", "failed_exchanges"):
        print(f"{name:<20} {found.get(name)}")
    for stage in STAGES:
        if f"{stage}_p50_us" in found:
            shares = (float(found[f"{stage}_{part}_us"]) for part in ("p50", "p99", "max"))
            print(f"{stage:<20} {' / '.join(f'{value:.0f}' for value in shares)} us (p50 / p99 / max)")
    machine = {"processor": platform.machine(), "cores": os.cpu_count() or 0, "load_average": os.getloadavg()[0]}
    write_json(arguments.out, {"run": found, "machine": machine})
    return int(found["reason"] != StopReason.DURATION.value or float(found["failed_exchanges"]) > 0)


if __name__ == "__main__":
    sys.exit(main())
