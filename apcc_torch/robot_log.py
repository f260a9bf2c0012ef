"""python -m apcc_torch.robot_log: what is in a run's log, the same run through the controller again, other formats."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from apcc_torch.classes import ALLOWED
from apcc_torch.composition.arguments import Arguments
from apcc_torch.errors import ApccError, DataError
from apcc_torch.experiments.realtime_run import replay_log
from apcc_torch.experiments.recorded_run import of_log
from apcc_torch.hardware.log_export import write_parquet, write_recording, write_rerun
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.messages.foxglove_file import write_foxglove
from apcc_torch.messages.log_bag import write_bag
from apcc_torch.plain_text import for_terminal
from apcc_torch.processes import stoppable
from apcc_torch.viewing.recorded import Recorded

TOLERANCE = 1e-9
"""Largest difference of a replayed command from the logged one that counts as the same, m."""

NAMED = 3
"""Most things that are wrong with a log, of those that are named."""

Answer = tuple[str, int]
"""What to print, and the exit code."""


def info(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """What the log holds."""
    cut = "cut off, by a kill or a full disk; this is what is left"
    whole = "damaged; this is what can be read" if record.damage else "complete" if record.complete else cut
    lines = [f"{arguments.log}: {whole}"]
    for name, rows in sorted(record.topics.items()):
        timed = rows["time"] if "time" in (rows.dtype.names or ()) else rows[:0]
        span = f"{timed[0]:.3f} to {timed[-1]:.3f} s" if timed.dtype == np.float64 and timed.ndim == 1 else ""
        lines.append(f"  {name:<14} {len(rows):>7} messages  {span}")
    lines += [f"  attached: {name}" for name in record.attachments]
    for event in record.events:
        reason = f" [{event['reason']}]" if event["reason"] else ""
        lines.append(f"  {event['time']:14.3f} s  {event['state']:<9} {event['kind']}{reason}: {event['message']}")
    return "\n".join(lines), 0


def replayed(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """How far the replayed commands are from the logged ones; exit code 1 if they are not the same."""
    ALLOWED.update(arguments.allow_class)
    result = replay_log(record)
    same = result.difference <= TOLERANCE
    verdict = "the same" if same else "not the same"
    return f"{len(result.time)} control steps, largest difference {result.difference:.3g} m: {verdict}", int(not same)


def parquet(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """Writes one parquet file a topic."""
    folder = arguments.out or Path(arguments.log).with_suffix("")
    return "\n".join(str(path) for path in write_parquet(record, folder)), 0


def rerun(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """Writes a recording for the rerun viewer."""
    return str(write_rerun(record, arguments.out or Path(arguments.log).with_suffix(".rrd"))), 0


def recording(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """Writes a recording that can be replayed and identified."""
    return str(write_recording(record, arguments.out or Path(arguments.log).with_name("recording.csv"))), 0


def foxglove(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """Writes an MCAP file that Foxglove opens."""
    path = arguments.out or Path(arguments.log).with_name("foxglove.mcap")
    return str(write_foxglove(run_of(record, arguments), path, record)), 0


def bag(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """Writes a bag of ROS 2."""
    path = arguments.out or Path(arguments.log).with_name("bag")
    return str(write_bag(record, path, run_of(record, arguments))), 0


def run_of(record: RobotLog, arguments: argparse.Namespace) -> Recorded | None:
    """The log as a run; None, with the reason among its damage, where it lacks what draws an arm."""
    ALLOWED.update(arguments.allow_class)
    try:
        return of_log(record, Path(arguments.log).stem)
    except DataError as error:
        record.damage.append(f"the arm, its tip and target are left out: {error}")
        return None


def attachments(record: RobotLog, arguments: argparse.Namespace) -> Answer:
    """The attached files."""
    return "\n".join(f"# {name}\n{text}" for name, text in record.attachments.items()), 0


COMMANDS: dict[str, tuple[Callable[[RobotLog, argparse.Namespace], Answer], str]] = {
    "info": (info, "topics, events, and whether the file is complete"),
    "replay": (
        replayed,
        f"run it through the controller again; exit code 1 if a command differs by over {TOLERANCE:g} m",
    ),
    "parquet": (parquet, "one parquet file a topic (needs pyarrow)"),
    "rerun": (rerun, "a recording for the rerun viewer (needs rerun-sdk)"),
    "recording": (recording, "a recording.csv, as simulate experiment=replay and identify read it"),
    "foxglove": (
        foxglove,
        "an MCAP file that Foxglove opens: frames, poses, the arm, all numbers (needs foxglove-sdk)",
    ),
    "bag": (bag, "a bag of ROS 2, as identify and simulate experiment=replay read it too (needs rosbags)"),
    "attachments": (attachments, "the attached files, such as the settings"),
}


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = Arguments(
        prog="python -m apcc_torch.robot_log",
        description="Reads log.mcap of a run of apcc_torch.robot. A log that was cut off is read as far as it goes. "
        "Of a damaged one all that can be read is; what cannot is named, with exit code 2.",
    )
    commands = top.add_subparsers(dest="command", required=True)
    for name, (_, about) in COMMANDS.items():
        command = commands.add_parser(name, help=about, description=about)
        command.add_argument("log", type=Path, help="log.mcap of a run")
        if name in ("replay", "foxglove", "bag"):
            command.add_argument(
                "--allow-class",
                action="append",
                default=[],
                metavar="NAME",
                help="a class of yours that the log's settings may name, as package.module.Class; can be repeated",
            )
        if name in ("parquet", "rerun", "recording", "foxglove", "bag"):
            command.add_argument("--out", type=Path, help="folder or file to write; beside the log if not given")
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Console entry point; returns the exit code."""
    arguments = parser().parse_args(argv)
    damage: list[str] = []
    with stoppable(lambda by: sys.stderr.write(f"stopped by {by}\n")):
        try:
            record = read_log(arguments.log)
            damage = record.damage
            text, code = COMMANDS[arguments.command][0](record, arguments)
        except ApccError as error:
            return refused(arguments.log, [str(error), *damage])
        sys.stdout.write(for_terminal(f"{text}\n"))
    return refused(arguments.log, damage) if damage else code


def refused(path: Path, reasons: Sequence[str]) -> int:
    """Says in one sentence what is wrong with a log; returns the exit code."""
    more = f"; and {len(reasons) - NAMED} things more" if len(reasons) > NAMED else ""
    sentence = "; ".join(reasons[:NAMED]).removeprefix(f"{path} ").removeprefix(f"{path}: ")
    sys.stderr.write(for_terminal(f"{path}: {' '.join(sentence.split())}{more}\n"))
    return 2


if __name__ == "__main__":
    sys.exit(main())
