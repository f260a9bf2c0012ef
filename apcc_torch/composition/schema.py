"""The composed configuration that a command line changes, and the settings that it means."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from traceback import walk_tb
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.classes import Trust
from apcc_torch.composition.proportion import in_proportion
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError, Checks, ConfigError, DataError, in_a_line, one_sentence
from apcc_torch.files import yaml_in
from apcc_torch.plain_text import for_terminal
from apcc_torch.reading import MUST, check_key, defaults, nested_in, plain, read
from apcc_torch.settings import Settings, about_of, close, default_of, did_you_mean, keys

Root = TypeVar("Root", bound=Settings)

OTHERS = re.compile(r"-(cd|cp|cn|sc|-config-(dir|path|name)|-shell-completion)\b")
"""Options of hydra that bring a user's own configurations, which may hold keys of their own, or no settings at all."""


_HYDRAS = ("hydra", "hydra_plugins", "omegaconf")
_CLUSTERS = ("submitit", "ray")
_RAISES = "HYDRA_FULL_ERROR"
"""With it hydra raises what it refuses; it prints it otherwise, with all that there is to choose from and where."""


def schema(root: type[Settings]) -> DictConfig:
    """Every key of a root with its default, for hydra to merge files and a command line into.

    Its groups take any key: `typed` refuses what a group, or the part that is chosen for it, does not have.
    """
    node = OmegaConf.create(_chosen(defaults(root), root))
    assert isinstance(node, DictConfig)  # of a mapping
    for value in node.values():
        if isinstance(value, DictConfig):
            OmegaConf.set_struct(value, False)
    return node


def _chosen(values: dict[str, Any], root: type[Settings]) -> dict[str, Any]:
    """Defaults without the settings of parts that another choice replaces: their classes alone."""
    for each in keys(root):
        default = default_of(each)
        if about_of(each).base is not None:
            values[each.name] = {} if default is None else {"kind": values[each.name]["kind"]}
        elif default is None and nested_in(root, each.name) is not None:
            values[each.name] = {}
        elif isinstance(default, Settings):
            _chosen(values[each.name], type(default))
    return values


def check_words(words: Sequence[str], root: type[Settings], config: str) -> None:
    """Raises ConfigError where a word of a command line sets what is neither a key, nor a group, nor hydra's own."""
    if any(OTHERS.match(word) for word in words):
        return
    known = [each.name for each in keys(root)]
    checks = Checks()
    for word in words:
        key = re.match(r"(\w+)([\w./@:-]*)=", word)
        with checks.one():
            if key is not None and key[1] in known:
                _check_path(f"{key[1]}{key[2]}".split("."), root)
            elif key is not None and key[1] not in (*groups(config), "hydra"):
                check_key(key[1], root)
    checks.end()


@cache
def groups(config: str) -> dict[str, tuple[str, ...]]:
    """What a configuration of the package lets choose, in its order: group to names, none of hydra's own groups."""
    folder = Path(conf_path())
    file = folder / f"{config}.yaml"
    entries = yaml_in(file.read_text(encoding="utf-8"), file.name)["defaults"]
    chosen = [name.removeprefix("override ") for entry in entries if isinstance(entry, dict) for name in entry]
    return {group: tuple(sorted(path.stem for path in (folder / group).glob("*.yaml"))) for group in chosen}


@contextmanager
def refused_in_a_sentence(tell: Callable[[str], object]) -> Iterator[None]:
    """Runs a program of hydra's: what hydra refuses ends it with exit code 2 and one sentence, not hydra's pages."""
    with one_sentence(tell):
        before = os.environ.get(_RAISES)
        os.environ[_RAISES] = "1"
        try:
            yield
        except Exception as error:
            if isinstance(error, ApccError) or not _is_hydras(error):
                raise
            if type(error).__module__.partition(".")[0] in _CLUSTERS:
                tell(for_terminal(sentence(error)))
                sys.exit(1)  # jobs failed, nothing was refused
            raise ConfigError(sentence(error)) from error
        finally:
            if before is None:
                del os.environ[_RAISES]
            else:
                os.environ[_RAISES] = before


def _is_hydras(error: Exception) -> bool:
    """Whether hydra raised it, or what hydra calls, and not a program that it runs: it has a dozen kinds of errors."""
    packages = [frame.f_globals.get("__name__", "").partition(".")[0] for frame, _ in walk_tb(error.__traceback__)]
    return next((name for name in reversed(packages) if name in ("apcc_torch", *_HYDRAS)), "") in _HYDRAS


def _check_path(path: Sequence[str], root: type[Settings]) -> None:
    """As far as the classes are known before anything is chosen."""
    for depth, name in enumerate(path):
        check_key(name, root, ".".join(path[:depth]))
        nested = nested_in(root, name)
        if nested is None:
            return
        root = nested


def sentence(error: Exception) -> str:
    """What hydra or OmegaConf say of an error, as one sentence; of a choice that there is not, with what there is."""
    said, _, options = str(error).partition("Available options in ")
    lines = [line.strip() for line in said.strip().splitlines()] or [in_a_line(error)]
    choice = re.search(r"Could not find '([\w/]+)/([^/']+)'", lines[0])
    if options and choice is not None:
        names = options.partition("Config search path")[0].split()[1:]
        return f"{choice[1]} has no choice {choice[2]!r}{_meant(choice[1], choice[2], names)}"
    word = getattr(error, "override", None)  # of what hydra cannot parse
    if isinstance(word, str):
        return f"{word!r} cannot be read: {lines[lines[0].startswith('Error parsing override')]}"
    key = re.match(r"Could not override '([^']+)'", lines[0])
    return lines[0] if key is None else f"{key[1]} is no setting"


def _meant(group: str, name: str, names: Sequence[str]) -> str:
    """The choice of a group that a name may stand for, else one of another group, else what there is."""
    others = {path.stem: path.parent.name for path in sorted(Path(conf_path()).glob("*/*.yaml"))}
    if not close(name, names) and (other := close(name, others)) is not None and others[other] != group:
        return f"; did you mean {others[other]}={other}?"
    return did_you_mean(name, names)


def values_of(cfg: DictConfig) -> dict[str, Any]:
    """What hydra composed, as plain values, without hydra's own.

    Raises:
        ConfigError: A value refers to what there is not.
    """
    try:
        return {str(key): _value(cfg, key) for key in cfg if key != "hydra"}
    except OmegaConfBaseException as error:
        at = f"{error.full_key}: " if getattr(error, "full_key", None) else ""
        raise ConfigError(f"{at}{sentence(error)}") from error


def _value(cfg: DictConfig, key: Any) -> Any:
    """A plain value, or `MUST` where it is still to be given."""
    if OmegaConf.is_missing(cfg, key):
        return MUST
    value = cfg[key]
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def typed(cfg: DictConfig, root: type[Root]) -> Root:
    """The settings that a composed configuration means.

    Raises:
        ConfigError, ValueRangeError: A key is unknown or missing, a value of the wrong type or out of range.
    """
    values = values_of(cfg)
    for name in values:
        if name in root.elsewhere:
            what = f"experiment={values['experiment']['name']}" if "experiment" in values else "this"
            raise ConfigError(f"{what} is for {root.elsewhere[name]}: it sets {name}")
    return read(in_proportion(values, root), root)


def text(settings: Settings) -> str:
    """Settings as YAML that reads back."""
    return OmegaConf.to_yaml(OmegaConf.create(plain(settings)))


def from_text(content: str, root: type[Root]) -> Root:
    """The settings of a file that may come from elsewhere, such as a log's: plain values, in which nothing is resolved.

    Raises:
        ConfigError, ValueRangeError: They have no meaning, or name a class that is neither of this package nor allowed.
    """
    try:
        values = yaml_in(content, "the file of settings")
    except DataError as error:
        raise ConfigError(str(error)) from error
    return read(values, root, trust=Trust.OWN)
