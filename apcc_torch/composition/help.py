"""The keys of a command as a table for `--help`: name, value, unit, source, meaning."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from apcc_torch.composition.schema import groups, typed
from apcc_torch.composition.unread import Unread, reasons_of, why_unread
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError
from apcc_torch.reading import nested_in
from apcc_torch.settings import Settings, about_of, default_of, differs, keys

WIDTH = 118


class Command(NamedTuple):
    """What is told of a command: see `describe`."""

    root: type[Settings]
    config: str
    unread: Callable[[Any], Unread] | None
    experiments: Sequence[str]
    choice: str


COMMANDS: dict[str, Command] = {}
"""By name."""


class Row(NamedTuple):
    """One key: its dotted name, its value as text, its unit, what it means, and where the value comes from.

    source: "paper" or "ours" of a default; "set; ours 0.2" where it is not the default, which is 0.2; "" of a group.
    choices: What it may be, where that is a few words.
    """

    key: str
    value: str
    unit: str
    source: str
    meaning: str
    choices: tuple[str, ...] = ()


def rows(settings: Settings | type[Settings], prefix: str = "") -> Iterator[Row]:
    """Every key of settings, or of a class with its defaults, group by group; a group's own row says what it is.

    A part that may be left out and is, has its keys too: it is there once one of them is set.
    """
    kind = settings if isinstance(settings, type) else type(settings)
    for each in keys(kind):
        about, key = about_of(each), f"{prefix}{each.name}"
        value = default_of(each) if settings is kind else getattr(settings, each.name)
        absent = nested_in(kind, each.name)
        if isinstance(value, Settings):
            yield Row(key, _shown(value) if about.base is not None else "", "", "", about.meaning)
            yield from rows(value, f"{key}.")
        elif absent is not None and (value is None or value is MISSING):
            yield Row(key, "null" if value is None else "", "", "", about.meaning)
            yield from rows(absent, f"{key}.")
        else:
            source = about.source
            if default_of(each) is MISSING:
                source = "to be set"
            elif differs(each, value):
                source = f"set; {source} {_shown(default_of(each))}"
            choices = ("true", "false") if isinstance(value, bool) else about.choices
            yield Row(key, _shown(value), about.unit, source, about.meaning, choices)


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, Settings):
        return getattr(type(value), "part", type(value)).__name__
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_shown(entry) for entry in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {_shown(entry)}' for name, entry in value.items())}}}"
    return str(value)


def table(settings: Settings, idle: Mapping[str, str] | None = None) -> str:
    """The keys as text, one a line.

    Args:
        settings: With the values that are shown.
        idle: Keys, or groups of them, that nothing reads -> why: told in a few lines below.
    """
    idle = idle or {}
    lines = []
    for row in rows(settings):
        if why_unread(row.key, idle) is not None:
            continue
        indent = "  " * row.key.count(".")
        if not row.source:
            lines += ["", f"{indent}{row.key}  {row.value}".rstrip() + f"   {row.meaning}"]
            continue
        value = textwrap.shorten(row.value, 34, placeholder=" …")
        unit = f" {row.unit}" if row.unit else ""
        head = f"{indent}{row.key}={value}{unit}"
        words = textwrap.wrap(f"[{row.source}] {row.meaning}", max(40, WIDTH - max(53, len(head) + 1)))
        lines += [f"{head if i == 0 else '':<52} {line}" for i, line in enumerate(words)]
    if idle:
        lines += ["", "Not read with these choices:"]
    reasons: dict[str, list[str]] = {}
    for key, why in idle.items():
        reasons.setdefault(why, []).append(key)
    for why, keys_of_it in reasons.items():
        told = f"{', '.join(keys_of_it)}: {why}"
        lines += textwrap.wrap(told, WIDTH, initial_indent="  ", subsequent_indent="    ")
    return "\n".join(lines)


def _keys_of(command: str, *, _root_: DictConfig) -> str:
    root, unread = COMMANDS[command].root, COMMANDS[command].unread
    try:
        settings = typed(_root_, root)
        told = table(settings, None if unread is None else reasons_of(unread(settings)))
    except ApccError as error:
        told = f"These settings do not fit: {error}"
    return told.replace("$", "$$")  # hydra reads its template's dollars


def _groups_of(command: str) -> str:
    lines = []
    for group, names in groups(COMMANDS[command].config).items():
        lines += ["", group] if names else []
        own = COMMANDS[command].experiments if group == "experiment" else ()
        for name in own or names:
            path = Path(conf_path(), group, f"{name}.yaml")
            # One that begins as another of them stands under it.
            first = f"    {'  ' if _begins_as(path) in own else ''}{name:<26}"[:30]
            lines += textwrap.wrap(_head(path), WIDTH, initial_indent=f"{first} ", subsequent_indent=31 * " ")
    return "\n".join(lines)


def _begins_as(path: Path) -> str:
    """The preset of the same group that a preset begins as; "" where it begins by itself."""
    entries = OmegaConf.select(OmegaConf.load(path), "defaults", default=())
    return next((entry for entry in entries if entry != "_self_" and isinstance(entry, str)), "")


def _head(path: Path) -> str:
    """The first sentence that a configuration says of itself."""
    comments = re.match(r"((?:#.*\n)*)", path.read_text(encoding="utf-8"))[1]  # type: ignore[index]
    words = " ".join(line.removeprefix("# ") for line in comments.splitlines() if "@package" not in line)
    return re.split(r"\.(?: (?=[A-Z[])|$)", words)[0].replace("$", "$$")


def for_manual(arguments: Sequence[str], word: str) -> list[str]:
    """Arguments that, where they ask for the manual, make a choice without which not every key is there.

    Args:
        arguments: Of a command line.
        word: The choice, GROUP=NAME, unless they choose of the group.
    """
    asked = [argument for argument in arguments if argument in ("-h", "--help")]
    group = word.partition("=")[0]
    if not asked or any(argument.startswith(f"{group}=") for argument in arguments):
        return list(arguments)
    return [*asked, *(argument for argument in arguments if argument not in asked), word]


def describe(
    command: str,
    root: type[Settings],
    config: str | None = None,
    unread: Callable[[Any], Unread] | None = None,
    experiments: Sequence[str] = (),
    choice: str = "",
) -> None:
    """Makes two resolvers of a command's help template: `${groups_of:COMMAND}`, the choices of its groups, and
    `${keys_of:COMMAND}`, every key with the value that the command would run with.

    Args:
        command: Its name.
        root: Its settings.
        config: The name of its configuration; None for the command's.
        unread: What its settings do not read: such keys are not listed.
        experiments: Those that it runs, one that begins as another after it; () for all that there are.
        choice: GROUP=NAME without which not every key is there; "" where each is.
    """
    COMMANDS[command] = Command(root, config or command, unread, experiments, choice)
    OmegaConf.register_new_resolver("keys_of", _keys_of, replace=True)
    OmegaConf.register_new_resolver("groups_of", _groups_of, replace=True)
