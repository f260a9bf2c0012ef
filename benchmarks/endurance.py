"""The runner for long: `python benchmarks/endurance.py` runs half an hour at 200 Hz and saves endurance.json.

The simulated arm tracks a curve in a process of its own, as `python -m apcc_torch.robot` runs it, with the log on disk.
Each second the runner's memory is read. The script fails, with exit code 1, where the run did not come to its end or
where its log replays to other commands, to the last bit. Lateness and missed periods are the machine's as much as the
runner's: two processes need two free cores.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.experiments import realtime_run
from apcc_torch.files import write_json
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from apcc_torch.sweeps.schemas import keep_schema

keep_schema("realtime_schema", RealtimeSettings)

SETTLED = (0.4, 0.95)
"""Shares of the run between which its memory's slope is taken: before them buffers fill up to their size, and behind
them the run is made into numbers."""


def settings(rate: float, seconds: float, more: list[str]) -> RealtimeSettings:
    """Tracking, to the end however busy the machine is."""
    overrides = [
        "experiment=tracking",
        "experiment.payloads=[0.0]",
        f"experiment.duration={seconds}",
        f"loop.rate={rate}",
        f"hardware.sensor.rate={rate}",
        "loop.hold=0.0",
        "loop.fresh_timeout=60.0",
        "guards.max_error=null",
        "guards.max_pause=null",
        "guards.overruns=1000000000",
        "guards.sensing.stale=60.0",
        "guards.sensing.dropout=60.0",
        "guards.sensing.gate.reach=null",
        "guards.sensing.gate.max_speed=100.0",
        "guards.sensing.gate.max_angular_rate=1000.0",
        "view=false",
        *more,
    ]
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("realtime", overrides), RealtimeSettings)


class Memory:
    """Reads this process's memory each second; `with` begins and ends it.

    Attributes:
        samples: (time, s, and memory, kB) that the process wrote itself: of libraries the system takes pages away, and
            gives them back, as others need room.
    """

    def __init__(self) -> None:
        self.samples: list[tuple[float, float]] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._work, name="memory", daemon=True)

    def __enter__(self) -> Memory:
        self.thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self.over.set()
        self.thread.join()

    def _work(self) -> None:
        while not self.over.wait(1.0):
            told = Path("/proc/self/status").read_text().partition("RssAnon:")[2]
            self.samples.append((time.monotonic(), float(told.split()[0])))


def measure(config: RealtimeSettings, folder: Path) -> dict[str, float | str]:
    """One run: how it ended, its memory, its times, and what its log replays to."""
    with Memory() as memory:
        outcome, metrics = realtime_run.run(config, folder)
        ended = time.monotonic()
    found: dict[str, float | str] = {"reason": outcome.reason.value, "message": outcome.message} | metrics
    running = np.array([(at, kilobytes) for at, kilobytes in memory.samples if ended - outcome.duration < at < ended])
    if len(running) > 1:
        share = (running[:, 0] - running[0, 0]) / outcome.duration
        later = running[(share >= SETTLED[0]) & (share <= SETTLED[1])]
        found |= {"memory_begin_kB": running[0, 1], "memory_end_kB": running[-1, 1]}
        found |= {"memory_slope_kB_s": float(np.polyfit(*later.T, 1)[0]) if len(later) > 1 else np.nan}
    log = read_log(folder / "log.mcap")
    lateness = 1e6 * log.topic("/timing")["lateness"]
    found |= {f"lateness_p{share:g}_us": float(np.percentile(lateness, share)) for share in (50, 99, 99.9)}
    replayed = realtime_run.replay_log(log)
    return found | {"replayed_steps": float(len(replayed.time)), "replay_difference_m": replayed.difference}


def main() -> int:
    """Measures once; the exit code is 0 where the run came to its end and its log replays to the last bit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=200.0, help="of the loop and of the cameras, Hz")
    parser.add_argument("--out", type=Path, default=Path("endurance.json"))
    parser.add_argument("overrides", nargs="*", help="settings of apcc_torch.robot, as key=value")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        config = settings(arguments.rate, 60.0 * arguments.minutes, arguments.overrides)
        found = measure(config, Path(folder))
    shown = ["reason", "message", "turns", "control_steps", "missed_deadlines"]
    shown += ["memory_begin_kB", "memory_end_kB", "memory_slope_kB_s"]
    shown += [f"lateness_{part}_us" for part in ("p50", "p99", "p99.9", "max")]
    for name in (*shown, "simulated_arm_behind_s", "replayed_steps", "replay_difference_m"):
        value = found.get(name)
        print(f"{name:<24} {f'{value:.10g}' if isinstance(value, float) else value}")
    machine = {"processor": platform.machine(), "cores": os.cpu_count() or 0, "load_average": os.getloadavg()[0]}
    write_json(arguments.out, {"run": found, "machine": machine})
    exact = found["replay_difference_m"] == 0.0
    print(f"the log's replay is {'' if exact else 'not '}bit-exact")
    return int(not (exact and found["reason"] == StopReason.DURATION.value))


if __name__ == "__main__":
    sys.exit(main())
