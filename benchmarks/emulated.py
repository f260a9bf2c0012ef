"""The whole runner on the emulated platform: `PYTHONPATH=tests python benchmarks/emulated.py` saves emulated.json.

The real Dynamixel SDK talks to motors on a pseudo terminal, the real NatNet parser to cameras on loopback, or with
--cameras qualisys the real parser of QTM's protocol, each in a process of its own; in between is an arm that follows
the tendons by kinematics. The run tracks a curve, calibrated first as on the arm. It fails, with exit code 1, where the
budget of missed deadlines is spent, where one exchange with a motor fails, or where the log replays to other commands.
Three processes need as many free cores: deadlines that a busy machine misses say nothing about the runner.

`--motors` takes other motors: Dynamixels that are told velocities, of mixed models, or Feetech's.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
from pathlib import Path

import numpy as np

from apcc_torch.experiments import calibrate as arm_calibration
from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.files import write_json
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.stops import StopReason
from apcc_torch.hardware.summary import STAGES
from composed import composed_realtime
from hardware.emulators.kinds import DYNAMIXEL, KINDS, Kind
from hardware.emulators.rig import MAKES, EmulatedPlatform

# What the guards are on the arm: more than 5 missed deadlines in a second end the run.
OVERRUNS, WINDOW = 5, 1.0
BUDGET = (f"guards.overruns={OVERRUNS}", f"guards.overrun_window={WINDOW}", "guards.failed_exchanges=5")
LATE = 0.1  # of a period: a turn that began later than that is late, though its deadline may have been kept
SAME = 1e-9  # m between a command and its replay
CURVE = ("experiment=tracking", "experiment.payloads=[0.0]", "experiment.A=[0.1,0.1,0.03]", "loop.hold=0.0")


def measure(
    kind: Kind, cameras: str, rate: float, seconds: float, folder: Path, more: list[str]
) -> dict[str, float | str]:
    """One run at a rate; its metrics, how it ended, and the exchanges that failed."""
    with EmulatedPlatform(folder, rate, kind, cameras) as emulated:
        file = folder / "arm.json"
        prompt = [f"hardware.actuator.{key}={value}" for key, value in kind.prompt.items()]
        common = [*emulated.overrides, *prompt, "view=false", f"calibration.file={file}"]
        outcome, _ = arm_calibration.run(composed_realtime("experiment=calibration", *common), folder)
        if outcome.reason is not StopReason.COMPLETED:
            return {"reason": outcome.reason.value, "message": outcome.message}
        settings = [*CURVE, *common, *BUDGET, f"loop.rate={rate}", f"experiment.duration={seconds}", *more]
        outcome, metrics = realtime.run(composed_realtime(*settings), folder)
    found: dict[str, float | str] = {"reason": outcome.reason.value, "message": outcome.message} | metrics
    if not outcome.ticks:
        return found
    log = read_log(folder / "log.mcap")
    failed = sum(event["kind"] == "exchange_failed" for event in log.events)
    found |= punctuality(log, rate, outcome)
    return found | {"failed_exchanges": float(failed), "replay_difference_m": realtime.replay_log(log).difference}


def punctuality(log: RobotLog, rate: float, outcome: Outcome) -> dict[str, float]:
    """Turns that began late, and the most deadlines that were missed within one window of the budget."""
    timing = log.topic("/timing")[: outcome.ticks + 1]
    # A turn's own row has what was missed before it.
    missed = np.repeat(timing["time"], np.diff(timing["overruns"].astype(int), append=outcome.overruns))
    within = [np.count_nonzero((missed > time - WINDOW) & (missed <= time)) for time in missed]
    late = np.count_nonzero(timing["lateness"] > LATE / rate)
    return {"late_turns": float(late), "missed_deadlines_in_a_window_max": float(max(within, default=0))}


def failures(found: dict[str, float | str]) -> list[str]:
    """Why the run did not pass, a sentence each; none where it did."""
    said = []
    if found["reason"] != StopReason.DURATION.value:
        said.append(f"it ended as {found['reason']}: {found['message']}")
    for name, limit, what in (
        (
            "missed_deadlines_in_a_window_max",
            OVERRUNS,
            f"missed deadlines within {WINDOW:g} s, the budget is {OVERRUNS}",
        ),
        ("failed_exchanges", 0, "exchanges with the motors failed"),
        ("replay_difference_m", SAME, "m between a command and its replay"),
    ):
        if not float(found.get(name, 0.0)) <= limit:
            said.append(f"{float(found[name]):g} {what}")
    return said


def main() -> int:
    """Measures once; the exit code is 0 where the run came to its end with its budget kept and no failed exchange."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motors", choices=tuple(KINDS), default=DYNAMIXEL.name)
    parser.add_argument("--rate", type=float, default=100.0, help="of the loop and of the cameras, Hz")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cameras", choices=tuple(MAKES), default="optitrack")
    parser.add_argument("--out", type=Path, default=Path("emulated.json"))
    parser.add_argument("overrides", nargs="*", help="settings of apcc_torch.robot, as key=value")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        given = arguments
        found = measure(KINDS[given.motors], given.cameras, given.rate, given.seconds, Path(folder), given.overrides)
    shown = ("reason", "message", "turns", "control_steps", "late_turns", "missed_deadlines")
    for name in (*shown, "missed_deadlines_in_a_window_max", "failed_exchanges", "replay_difference_m"):
        print(f"{name:<33} {found.get(name)}")
    for stage in STAGES:
        if f"{stage}_p50_us" in found:
            shares = (float(found[f"{stage}_{part}_us"]) for part in ("p50", "p99", "max"))
            print(f"{stage:<33} {' / '.join(f'{value:.0f}' for value in shares)} us (p50 / p99 / max)")
    machine = {"processor": platform.machine(), "cores": os.cpu_count() or 0, "load_average": os.getloadavg()[0]}
    write_json(arguments.out, {"motors": arguments.motors, "run": found, "machine": machine})
    wrong = failures(found)
    print(
        f"failed: {'; '.join(wrong)}" if wrong else f"passed: at most {OVERRUNS} missed deadlines in any {WINDOW:g} s"
    )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
