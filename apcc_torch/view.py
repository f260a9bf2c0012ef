"""python -m apcc_torch.view: an arm that follows a target you drag, or a finished run, in the browser."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import torch

from apcc_torch.composed import compose
from apcc_torch.composition.arguments import Arguments
from apcc_torch.composition.arm_file import SUFFIXES
from apcc_torch.errors import ConfigError, one_sentence
from apcc_torch.experiments.recorded_run import recorded
from apcc_torch.messages.foxglove_file import write_foxglove
from apcc_torch.model.arm import Arm
from apcc_torch.plain_text import for_terminal
from apcc_torch.processes import stoppable
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.follower import Follower
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.player import Player
from apcc_torch.viewing.pursuit import Pursuit
from apcc_torch.web_address import WebAddress

EXPERIMENT = "setpoint"
"""Whose presets an arm is viewed with."""
ADDRESS = WebAddress()
MANUAL = """\
WHAT is one of
  an arm         arm_1, or a file such as mine.yaml: a simulated arm under its controller, in real time. Drag the
                 green target by its arrows; the arm follows. Pause, reset, and a load at its tip are on the page.
  a run          the folder of python -m apcc_torch.simulate, or of python -m apcc_torch.robot, or a log.mcap: the same
                 scene with a time slider.
An arm takes KEY=VALUE as python -m apcc_torch.simulate experiment=setpoint does, --help there lists them. Its loop is
built as machine code when it is first viewed, which takes about half a minute, and kept; compile=off goes without.

Sections are transparent, each in a colour of its own; the dark line within is the controller's model. Red collars are
sensors, purple ellipsoids where they may be, as far as is known, enlarged; tendons redden as they tighten.
With --foxglove a run becomes an MCAP file that Foxglove opens; python -m apcc_torch.robot_log foxglove LOG adds all
that a log holds.
The page is served to this machine alone; --host 0.0.0.0 serves it to all who reach it, and they may use its controls.
Ctrl-C ends it.

examples:
  python -m apcc_torch.view arm_1
  python -m apcc_torch.view mine.yaml controller.K=3 sensors=mocap
  python -m apcc_torch.view arm_1 adaptation=none plant.arm.mass=0.6
  python -m apcc_torch.view runs/dynamic_run_2/DATE --row 4
  python -m apcc_torch.view runs/robot/setpoint_DATE/log.mcap --port 8090
  python -m apcc_torch.view runs/dynamic_run_2/DATE --foxglove run.mcap
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Arguments.described("view", "Shows an arm or a run in the browser.", MANUAL)
    made.add_argument("what", metavar="WHAT", help="an arm's name or file, a run's folder, or a log")
    made.add_argument("changes", metavar="KEY=VALUE", nargs="*", help="settings, where it is an arm")
    made.add_argument("--host", default=ADDRESS.host, help=f"address to serve the page on; {ADDRESS.host} if not given")
    made.add_argument(
        "--port", type=int, default=ADDRESS.port, help=f"its port; 0 for any free one; {ADDRESS.port} if not given"
    )
    made.add_argument(
        "--foxglove", type=Path, metavar="FILE", help="of a run: write it as this MCAP file for Foxglove, and no page"
    )
    made.add_argument("--row", type=int, default=0, help="of a run: which of its rows first; 0 if not given")
    return made


def is_run(what: str) -> bool:
    """Whether a run is meant, and no arm: a path that is there, and no arm's file."""
    path = Path(what)
    return path.exists() and path.suffix not in SUFFIXES


def show_arm(given: argparse.Namespace, address: WebAddress, over: threading.Event) -> None:
    """Lets a simulated arm follow the target on its page, until it is over."""
    if given.row or given.foxglove:
        option = "--row" if given.row else "--foxglove"
        raise ConfigError(f"{option} is of a run, and {given.what} is an arm")
    arm = Arm.load(given.what)
    words = [f"experiment={EXPERIMENT}", f"arm={given.what}", "compile=auto", *given.changes]
    settings = compose(*words).settings
    if settings.compile != "off":
        sys.stderr.write(
            for_terminal(f"{given.what}: its loop is built, which may take half a minute the first time\n")
        )
    pursuit, size = Pursuit(settings), DrawnSize.of(settings.arm)
    if size.upward and not any(word.startswith("experiment.setpoints") for word in given.changes):
        pursuit.target = pursuit.target * (1.0, 1.0, -1.0)  # the preset's is below the base
    with Page(address, arm.name, *_camera(size)) as page:
        follower = Follower(page, pursuit)
        tell(page, "drag the green target")
        follower.run(over)


def show_run(given: argparse.Namespace, address: WebAddress, over: threading.Event) -> None:
    """Shows a finished run on its page, until it is over."""
    if given.changes:
        raise ConfigError(f"{given.changes[0]} is read by nothing: the run is over; KEY=VALUE is for an arm")
    run = recorded(Path(given.what))
    if not 0 <= given.row < len(run.rows):
        raise ConfigError(f"--row must be 0 to {len(run.rows) - 1}, got {given.row}")
    with Page(address, run.name, *_camera(run.size)) as page:
        player = Player(page, run, given.row)
        tell(page, "play, or move the time")
        player.run(over)


def write_run(given: argparse.Namespace) -> None:
    """Writes a finished run for Foxglove."""
    path = Path(given.what)
    sys.stdout.write(f"{write_foxglove(recorded(path), given.foxglove, row=given.row)}\n")


def tell(page: Page, what: str) -> None:
    """Says where the page is."""
    sys.stdout.write(f"{page.address.url}: {what}; Ctrl-C ends it\n")
    sys.stdout.flush()


def _camera(size: DrawnSize) -> tuple[float, bool]:
    return size.length, size.upward


def main(argv: Sequence[str] | None = None) -> None:
    """Console entry point; returns when it is ended by a signal alone."""
    given = parser().parse_args(argv)
    torch.set_num_threads(1)
    over = threading.Event()
    with (
        stoppable(lambda by: sys.stderr.write(f"stopped by {by}\n")),
        one_sentence(lambda said: sys.stderr.write(f"apcc_torch.view: {said}\n")),
    ):
        if given.foxglove and is_run(given.what):
            return write_run(given)
        address = WebAddress(host=given.host, port=given.port).free("--")
        (show_run if is_run(given.what) else show_arm)(given, address, over)


if __name__ == "__main__":
    main()
