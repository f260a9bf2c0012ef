"""What a program does with its folder, from hydra's side: it takes one that is free, and holds it until its end."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from apcc_torch.composition.arguments import Arguments
from apcc_torch.composition.arm_file import literal, quoted
from apcc_torch.composition.schema import refused_in_a_sentence, sentence
from apcc_torch.errors import REFUSED, ApccError, ConfigError, one_sentence
from apcc_torch.experiments.run import METRICS, PRUNED
from apcc_torch.plain_text import plain_logger
from apcc_torch.processes import stoppable
from apcc_torch.sweeps.folder_lock import FolderLock

log = plain_logger("apcc_torch")

RESULTS = (METRICS, PRUNED, "log.mcap", "CMakeLists.txt")
"""Files that a run is known by, which another one must not replace unasked."""
BESIDE = (
    *("trajectory.npz", "replay.npz", "events.json", "table.*", "searched.json", "parameters.json", "data/*.npz"),
    *("points.csv", "points/**/*", "figures/**/*.png", "figures/**/*.gif", "figures/**/*.mp4"),
)
"""What else a run leaves, and must not be taken for another's."""
NOTHING_RUN = re.compile(r"(.*/)?(\.hydra/\w+\.yaml|[\w.-]+\.log|config\.yaml|multirun\.yaml|\.lock)")
"""What there is in a folder before anything is run."""


def dir_override(key: str, path: Path) -> str:
    """The override that sets a folder, quoted where hydra would not take it as it is."""
    text = literal(str(path))
    if not re.fullmatch(r"[\w./-]+", text, re.ASCII):
        text = quoted(text)
    return f"{key}={text}"


def place(config: DictConfig, key: str) -> Path:
    """Makes the folder of a run or a sweep absolute, for workers that start elsewhere, and returns it.

    One that the command line does not name is made here, under a name that no other run has.

    Args:
        config: What hydra composed.
        key: hydra.run.dir or hydra.sweep.dir.
    """
    node = config.hydra[key.split(".")[1]]
    path = Path(os.path.abspath(str(node.dir)))
    others = [o for o in config.hydra.overrides.hydra if o.partition("=")[0].lstrip("+") != key]
    if len(others) == len(config.hydra.overrides.hydra) and not config.get("resume"):
        path = new_folder(path)
    with read_write(config), open_dict(config):
        node.dir = literal(str(path))
        # Each job is composed anew from the command line.
        config.hydra.overrides.hydra = [*others, dir_override(key, path)]
    return path


def new_folder(path: Path) -> Path:
    """Makes the first that is free of NAME, NAME-2, NAME-3, ..."""
    path.parent.mkdir(parents=True, exist_ok=True)
    free, k = path, 1
    while True:
        try:
            free.mkdir()
            return free
        except FileExistsError:
            k += 1
            free = path.with_name(f"{path.name}-{k}")


class Claim(Callback):
    """Hydra's view of a program's folder. Launchers copy callbacks into their workers: what is held is the class's."""

    held: ClassVar[FolderLock | None] = None
    made: ClassVar[list[Path]] = []
    """The program's folder and those that it is in, from the inside, as far as the program made them."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Takes the run's folder."""
        with or_no_run():
            self.take(config, "hydra.run.dir", "")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Takes the sweep's folder."""
        with or_no_run():
            self.take(config, "hydra.sweep.dir", "*/")

    @staticmethod
    def take(config: DictConfig, key: str, results: str | None) -> Path:
        """Holds the folder that `key` names, and returns it.

        Args:
            config: What hydra composed.
            key: hydra.run.dir or hydra.sweep.dir.
            results: Pattern of the folders in which an earlier run may have left its results; None: not looked for.

        Raises:
            ConfigError: It is in use, holds results that must not be written over, or cannot be written to.
        """
        path = asked = Path(os.path.abspath(str(config.hydra[key.split(".")[1]].dir)))
        missing = [each for each in (path, *path.parents) if not each.exists()]
        try:
            path = place(config, key)
            Claim.held = FolderLock(path)
            Claim.made = [path, *missing[1:]] if missing or path != asked else []
            there = [] if results is None else [found for name in RESULTS for found in path.glob(results + name)]
            if there and not config.overwrite:
                raise ConfigError(
                    f"{path} holds results ({there[0].relative_to(path)}): name another folder with {key}=DIR, or "
                    "overwrite=true writes over them"
                )
            for found in there:
                found.unlink()  # a folder with results is complete, and this one is not any more
            for old in [each for found in there for pattern in BESIDE for each in found.parent.glob(pattern)]:
                if not old.is_dir():
                    old.unlink(missing_ok=True)
        except OSError as error:
            raise ConfigError(f"{path} cannot be written to: {error.strerror}; name another with {key}=DIR") from error
        return path

    @staticmethod
    def forget() -> None:
        """Removes the folder of a program that was refused, where the program made it and nothing was run."""
        for folder in Claim.made[:1]:
            left = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()]
            if not all(map(NOTHING_RUN.fullmatch, left)):
                return
            shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # another program's folder may be beside it by now
            for outer in Claim.made[1:]:
                outer.rmdir()

    @classmethod
    def stopped(cls, by: str) -> None:
        """Tells that the program was stopped."""
        if Claim.held is None:
            log.error("stopped by %s; nothing was begun", by)
        else:
            folder = Claim.held.path.parent
            log.error("stopped by %s; what is in %s is not finished: run the same command again", by, folder)


def given(hydra: DictConfig | None = None) -> list[str]:
    """The words of a command line that set keys, as they were written: a reference in one is the key's, not hydra's.

    Args:
        hydra: What hydra composed for itself; None for that of the program that runs.
    """
    words = OmegaConf.to_container((HydraConfig.get() if hydra is None else hydra).overrides.task, resolve=False)
    assert isinstance(words, list)  # of a ListConfig
    return list(map(str, words))


@contextmanager
def or_no_run() -> Iterator[None]:
    """What a callback raises ends the program in a sentence: hydra would warn of it, and run without it."""
    with one_sentence(log.error):
        try:
            yield
        except ApccError:
            raise
        except Exception as error:
            raise ConfigError(sentence(error)) from error


def check_options(program: str) -> None:
    """Refuses, in one sentence, options that hydra would refuse with a page of usage.

    Raises:
        ConfigError: One of them would run what a file holds: hydra reruns a job from a pickle.
    """
    parser = Arguments(f"apcc_torch.{program}", parents=[get_args_parser()], add_help=False)
    if parser.parse_args(sys.argv[1:]).experimental_rerun is not None:  # its name may be cut short
        raise ConfigError(
            "--experimental-rerun is refused, as a pickle runs whatever its author wrote into it: give the words of "
            "the run's .hydra/overrides.yaml to the command instead"
        )


def refusals(program: str) -> AbstractContextManager[None]:
    """See `refused_in_a_sentence`: what hydra or the package refuses, on standard error, in the program's name."""
    return refused_in_a_sentence(lambda said: sys.stderr.write(f"apcc_torch.{program}: {said}\n"))


@contextmanager
def held_folder(claim: type[Claim] = Claim) -> Iterator[None]:
    """A program's whole life: Ctrl-C and its like end it in a sentence or two, and its folder is free afterwards.

    Of what is refused before anything is run, no folder is left.
    """
    try:
        with stoppable(claim.stopped):
            yield
    except SystemExit as ended:
        if ended.code == REFUSED:
            Claim.forget()
        raise
    finally:
        Claim.made = []
        if Claim.held is not None:
            Claim.held.release()
            Claim.held = None
