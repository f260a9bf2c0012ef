"""The loop in real time on the simulated arm: `python benchmarks/realtime.py` prints a table and saves realtime.json.

The arm runs in its own process and streams frames at the loop's rate, so the controller steps in every turn. `compute`
is a whole turn with a step: reading the tendons, judging the frame, the controller, clamping and sending. `latency` is
from a frame's stamp to the end of sending; it holds the wait for the next turn, up to a period, and the frame's way
here, which --frame-latency sets. Two processes need two free cores: `no new frame`, the share of turns without one, and
`arm behind` say if they had them not.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from contextlib import ExitStack
from pathlib import Path

from hydra import compose, initialize_config_dir

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.files import write_json
from apcc_torch.hardware.log import RunLog
from apcc_torch.hardware.realtime import freeze, realtime
from apcc_torch.hardware.runner import Runner
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.summary import STAGES, Summary
from apcc_torch.hardware.view import TerminalView
from apcc_torch.sweeps.schemas import keep_schema

keep_schema("realtime_schema", RealtimeSettings)

NEVER = 1e6
"""A limit that no run reaches: the loop is timed to its end however late it is."""


def settings(rate: float, arguments: argparse.Namespace) -> RealtimeSettings:
    """Tracking at one rate, with every guard on time out of the way."""
    overrides = [
        "experiment=tracking",
        "experiment.payloads=[0.0]",
        f"experiment.duration={arguments.seconds}",
        f"loop.rate={rate}",
        f"hardware.sensor.rate={rate}",
        f"hardware.sensor.latency={arguments.frame_latency}",
        "loop.hold=0.0",
        "loop.fresh_timeout=60.0",
        "loop.fresh_frames=1",
        "guards.max_error=null",
        f"guards.overruns={round(NEVER)}",
        f"guards.sensing.max_age={NEVER}",
        f"guards.sensing.stale={NEVER}",
        f"guards.sensing.dropout={NEVER}",
        *arguments.overrides,
    ]
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("realtime", overrides), RealtimeSettings)


def measure(rate: float, arguments: argparse.Namespace) -> dict[str, float]:
    """One run at a rate; its metrics."""
    config = settings(rate, arguments)
    build = RealtimeBuilder(config)
    actuator, sensor, world = build.devices()
    summary = Summary()
    observers: list[Summary | RunLog | TerminalView] = [summary]
    setup = Setup(
        actuator,
        sensor,
        build.sensing(),
        build.control(),
        build.limits(),
        build.guards(),
        config.loop,
        world.clock,
        config.experiment.duration,
        observers=observers,
        prepared=freeze,
    )
    with ExitStack() as stack:
        if not arguments.no_log:
            stream = stack.enter_context(Path(os.devnull).open("wb"))
            observers.append(stack.enter_context(RunLog(stream, build.layouts(), 0.0, {}, {})))
        if not arguments.no_view:
            observers.append(stack.enter_context(TerminalView(stack.enter_context(Path(os.devnull).open("w")))))
        stack.enter_context(realtime(arguments.priority))
        outcome = Runner(setup).run()
    metrics = summary.metrics(outcome) | world.metrics()
    metrics["turns_without_frame_share"] = 1.0 - metrics["control_steps"] / max(metrics["turns"], 1.0)
    metrics["missed_deadlines_share"] = metrics["missed_deadlines"] / max(metrics["turns"], 1.0)
    metrics["half_period_us"] = 0.5e6 / rate
    return metrics


def table(results: dict[str, dict[str, float]]) -> str:
    """The results as text: p50 / p99 in microseconds."""
    head = ["Hz", *STAGES, "missed", "no new frame", "arm behind"]
    lines = [head]
    for rate, m in results.items():
        cells = [f"{m[f'{name}_p50_us']:.0f} / {m[f'{name}_p99_us']:.0f}" for name in STAGES]
        shares = f"{100 * m['missed_deadlines_share']:.1f} %", f"{100 * m['turns_without_frame_share']:.1f} %"
        lines.append([rate, *cells, *shares, f"{m['simulated_arm_behind_s']:.2f} s"])
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def main() -> None:
    """Measures every rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[50.0, 100.0, 200.0, 500.0], help="Hz")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    parser.add_argument("--frame-latency", type=float, default=0.0, help="s from a frame's measurement to its arrival")
    parser.add_argument("--priority", type=int, help="of SCHED_FIFO for the loop, where the system allows it")
    parser.add_argument("--no-view", action="store_true", help="without the live view, which is drawn to nowhere")
    parser.add_argument("--no-log", action="store_true", help="without the log, which is written to nowhere")
    parser.add_argument("--out", type=Path, default=Path("realtime.json"))
    parser.add_argument("overrides", nargs="*", help="settings of apcc_torch.robot, as key=value")
    arguments = parser.parse_args()
    results = {}
    for rate in arguments.rates:
        results[f"{rate:g}"] = measure(rate, arguments)
        print(f"{rate:g} Hz done", file=sys.stderr)
    print("p50 / p99, us")
    print(table(results))
    about = {"cores": float(os.cpu_count() or 0), "load_average": os.getloadavg()[0], "seconds": arguments.seconds}
    write_json(arguments.out, {"rates": results, "machine": {"processor": platform.machine(), **about}})


if __name__ == "__main__":
    main()
