"""What a program does with its folder, from hydra's side: it takes one that is free, and holds it until its end."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, ClassVar

from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, open_dict, read_write

from apcc_torch.composition.schema import refused_in_a_sentence
from apcc_torch.errors import ConfigError, one_sentence
from apcc_torch.experiments.run import METRICS, PRUNED
from apcc_torch.processes import stoppable
from apcc_torch.sweeps.folder_lock import FolderLock

log = logging.getLogger("apcc_torch")

RESULTS = (METRICS, PRUNED, "log.mcap")
"""Files that a run is known by, which another one must not replace unasked."""


def literal(path: Path) -> str:
    """A folder as OmegaConf takes it: nothing in its name refers to another value."""
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", str(path))


def dir_override(key: str, path: Path) -> str:
    """The override that sets a folder, quoted where hydra would not take it as it is."""
    text = literal(path)
    if not re.fullmatch(r"[\w./-]+", text, re.ASCII):
        text = "'" + re.sub(r"(\\*)('|\Z)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), text) + "'"
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
        node.dir = literal(path)
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

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Takes the run's folder."""
        with one_sentence(log.error):
            self.take(config, "hydra.run.dir", "")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Takes the sweep's folder."""
        with one_sentence(log.error):
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
        path = Path(str(config.hydra[key.split(".")[1]].dir))
        try:
            path = place(config, key)
            Claim.held = FolderLock(path)
            there = [] if results is None else [found for name in RESULTS for found in path.glob(results + name)]
            if there and not config.overwrite:
                raise ConfigError(
                    f"{path} holds results ({there[0].relative_to(path)}): name another folder with {key}=DIR, or "
                    "overwrite=true writes over them"
                )
            for found in there:
                found.unlink()  # a folder with results is complete, and this one is not any more
        except OSError as error:
            raise ConfigError(f"{path} cannot be written to: {error.strerror}; name another with {key}=DIR") from error
        return path

    @classmethod
    def stopped(cls, by: str) -> None:
        """Tells that the program was stopped."""
        if Claim.held is None:
            log.error("stopped by %s; nothing was begun", by)
        else:
            folder = Claim.held.path.parent
            log.error("stopped by %s; what is in %s is not finished: run the same command again", by, folder)


def refusals(program: str) -> AbstractContextManager[None]:
    """See `refused_in_a_sentence`: what hydra or the package refuses, on standard error, in the program's name."""
    return refused_in_a_sentence(lambda said: sys.stderr.write(f"apcc_torch.{program}: {said}\n"), HydraException)


@contextmanager
def held_folder(claim: type[Claim] = Claim) -> Iterator[None]:
    """A program's whole life: Ctrl-C and its like end it in a sentence or two, and its folder is free afterwards."""
    try:
        with stoppable(claim.stopped):
            yield
    finally:
        if Claim.held is not None:
            Claim.held.release()
            Claim.held = None
