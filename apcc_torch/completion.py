"""What TAB completes on a command line of the programs: groups and their choices, keys, and values of a few words."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composition.arm_file import SUFFIXES, arm_override
from apcc_torch.composition.help import COMMANDS, rows
from apcc_torch.composition.schema import groups, typed
from apcc_torch.composition.unread import reasons_of, why_unread
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError
from apcc_torch.settings import Settings

ASKED = ("-sc", "--shell-completion")
"""Options of hydra's that a shell asks with; `query=bash` after them wants words, `install=bash` the shell's part."""
OPTIONS = ("--help", "--multirun", "--batch", "--config-dir", "--cfg")
PATHS = ("data", "data_root", "calibration.file", "hydra.run.dir", "hydra.sweep.dir")
"""Keys whose values are paths; arm's may be one."""


def answered(command: str, words: Sequence[str]) -> bool:
    """Prints what may stand where the cursor is, if that is what a shell asks for.

    Args:
        command: A described one, see `help.describe`.
        words: Its command line.

    Returns:
        Whether it was asked.
    """
    if not any(word in ASKED for word in words):
        return False
    query = next((word for word in words if word.startswith("query=")), None)
    if query is None:
        return False
    apart = "\n" if query == "query=fish" else " "
    sys.stdout.write(apart.join(completions(command, os.environ.get("COMP_LINE", ""))) + "\n")
    return True


def completions(command: str, line: str) -> list[str]:
    """The words that may stand at the end of a line.

    Args:
        command: A described one.
        line: The line up to the cursor, the program's name first.
    """
    begun, word = _split(line)
    word_head, equals, value = word.partition("=")
    found: Iterator[str]
    if word.startswith("-"):
        found = (option for option in OPTIONS if option.startswith(word))
    elif equals:
        found = (f"{word_head}={each}" for each in _values(command, begun, word_head, value))
    else:
        named = (f"{group}=" for group, names in groups(COMMANDS[command].config).items() if names)
        found = iter([*(g for g in named if g.startswith(word)), *_keys(command, begun, word)])
    return sorted(set(found))


def _split(line: str) -> tuple[list[str], str]:
    """The words of a line after the program's name, and the last one, which is not finished: "" behind a blank."""
    try:
        words = shlex.split(line)
    except ValueError:  # a quote is open
        words = line.split()
    last = "" if line[-1:].isspace() or not words else words.pop()
    begin = next((i for i, word in enumerate(words) if "=" in word or word.startswith("--")), len(words))
    return words[begin:], last


def _keys(command: str, begun: Sequence[str], word: str) -> Iterator[str]:
    """Keys up to the next dot behind `word`."""
    settings = _settings(command, begun)
    if settings is None:
        return
    unread = COMMANDS[command].unread
    idle = {} if unread is None else reasons_of(unread(settings))
    inner = {row.key.rpartition(".")[0] for row in rows(settings)}
    for row in rows(settings):
        if row.key.startswith(word) and why_unread(row.key, idle) is None:
            behind = row.key[len(word) :].partition(".")
            yield f"{word}{behind[0]}{'.' if behind[1] or row.key in inner else '='}"


def _settings(command: str, begun: Sequence[str]) -> Settings | None:
    """What the words so far mean, without those that mean nothing; None where nothing does."""
    sound = [word for word in begun if "=" in word and not word.startswith(("-", "hydra"))]
    choice = COMMANDS[command].choice
    group = choice.partition("=")[0]
    if choice and not any(word.startswith(f"{group}=") for word in sound):
        sound = [*sound, choice]
    chosen = [word for word in sound if word.partition("=")[0] in groups(COMMANDS[command].config)]
    for words in (sound, chosen, [choice] if choice else []):
        try:
            with initialize_config_dir(conf_path(), version_base="1.3"):
                return typed(compose(COMMANDS[command].config, arm_override(words)), COMMANDS[command].root)
        except (ApccError, HydraException, OmegaConfBaseException):
            continue
    return None


def _values(command: str, begun: Sequence[str], key: str, value: str) -> Iterator[str]:
    """What a group, or a key, may be set to that begins so: choices, files, or what it is set to."""
    told = COMMANDS[command]
    of_group = groups(told.config).get(key, ())
    names = told.experiments if key == "experiment" and told.experiments else of_group
    yield from (name for name in names if name.startswith(value))
    if key == "arm":
        yield from (path for path in _paths(value) if path.endswith((*SUFFIXES, "/")))
    elif key in PATHS:
        yield from _paths(value)
    elif not of_group and (settings := _settings(command, begun)) is not None:
        row = next((row for row in rows(settings) if row.key == key), None)
        shown = () if row is None else row.choices or (row.value.replace(" ", ""),)
        yield from (each for each in shown if each.startswith(value))


def _paths(begun: str) -> Iterator[str]:
    """Files and folders whose path begins so, folders with a slash behind."""
    prefix = begun[: begun.rfind("/") + 1]
    try:
        entries = sorted(Path(prefix).iterdir())
    except OSError:
        return
    for entry in entries:
        path = f"{prefix}{entry.name}{'/' if entry.is_dir() else ''}"
        if path.startswith(begun) and not entry.name.startswith("."):
            yield path
