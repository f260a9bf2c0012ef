"""The points of a batch: hydra's own sweep overrides, each combination of them the settings of one point."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composition.proportion import in_proportion
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import sentence, values_of
from apcc_torch.composition.stacking import Point
from apcc_torch.composition.unread import check_given, of_a_simulation
from apcc_torch.errors import Checks, ConfigError
from apcc_torch.reading import read

MOST = 100_000
"""Points of a sweep: each is composed, and checked, before the first is run."""
FLAG = "--batch"
"""On the command line: the sweeps after it are rows of one tensor batch."""


class Choice(NamedTuple):
    """One value of a swept key.

    override: As on a command line.
    key: What is swept, a key or a group.
    value: For `OmegaConf.update`; None of a group.
    text: For a table.
    plain: Whether it changes a key that is there already; else it takes part in the composition.
    """

    override: str
    key: str
    value: Any
    text: str
    plain: bool


def with_batch(arguments: Sequence[str]) -> list[str]:
    """A command line in which the sweeps after --batch have become the one override batch=[...].

    Raises:
        ConfigError: No sweep comes after it.
    """
    if FLAG not in arguments:
        return list(arguments)
    at = arguments.index(FLAG)
    after = [argument for argument in arguments[at + 1 :] if argument != FLAG]
    with _naming("batch"):
        parser = OverridesParser.create()
        given = [a for a in after if "=" in a and not a.startswith("-")]
        sweeps = [a for a in given if parser.parse_override(a).is_sweep_override()]
        # What a swept group takes the place of is there without it.
        swept = [a for s in sweeps for a in (f"~{s.partition('=')[0]}", s) if a in after]
    if not swept:
        raise ConfigError(f"{FLAG} needs a sweep after it, such as adaptation.gamma=10,20,40")
    kept = [argument for argument in after if argument not in swept]
    return [*arguments[:at], *kept, f"batch=[{','.join(map(_quoted, swept))}]"]


def batch_points(cfg: DictConfig, overrides: Sequence[str], config_name: str) -> list[Point]:
    """The points of `batch`, in the order in which a multirun of the same overrides would number its jobs.

    Hydra must be initialised, as it is inside its main function.

    Args:
        cfg: What hydra composed.
        overrides: The command line that it composed it from.
        config_name: The root configuration.

    Raises:
        ConfigError, ValueRangeError: An override or a point's settings have no meaning.
    """
    swept = _parsed(cfg.batch)
    if not swept:
        raise ConfigError("batch must hold at least one sweep, such as adaptation.gamma=10,20,40")
    ours = [override for override in overrides if override.partition("=")[0].lstrip("+") != "batch"]
    return points_of(cfg, ours, config_name, swept)


def points_of(cfg: DictConfig, ours: Sequence[str], config_name: str, swept: Iterable[Override]) -> list[Point]:
    """The points of sweeps, as `batch_points`.

    Args:
        cfg: What hydra composed.
        ours: The command line that it composed it from, without the sweeps.
        config_name: The root configuration.
        swept: The sweeps.

    Raises:
        ConfigError, ValueRangeError: An override or a point's settings have no meaning.
    """
    axes = [_choices(cfg, override) for override in swept]
    if math.prod(map(len, axes)) > MOST:
        raise ConfigError(f"a sweep may have {MOST} points, got {' times '.join(str(len(axis)) for axis in axes)}")
    bases: dict[tuple[str, ...], _Base] = {}
    points, checks = [], Checks()
    for index, chosen in enumerate(itertools.product(*axes)):
        composed = tuple(choice.override for choice in chosen if not choice.plain)
        with checks.one(), _naming(", ".join(choice.override for choice in chosen)):
            if composed not in bases:
                bases[composed] = _Base(compose(config_name, [*ours, *composed]) if composed else cfg)
            config = bases[composed].changed([choice for choice in chosen if choice.plain])
            points.append(Point(index, {choice.key: choice.text for choice in chosen}, config))
    checks.end()
    # Each point is a run by itself, which reads nothing of how the batch is run.
    given = [word for word in ours if not word.lstrip("+").startswith("batch_")]
    given += [f"{choice.key}=" for axis in axes for choice in axis[:1]]
    check_given(of_a_simulation, [point.config for point in points], given)
    return points


class _Base:
    """A composed configuration, and its settings with keys changed."""

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg
        self.values = values_of(cfg)
        # Where values refer to others, a change may reach further than its own key.
        self.linked = "${" in OmegaConf.to_yaml(OmegaConf.masked_copy(cfg, list(self.values)))

    def changed(self, choices: Sequence[Choice]) -> SimulateSettings:
        if self.linked:
            cfg = self.cfg.copy()
            for choice in choices:
                OmegaConf.update(cfg, choice.key, choice.value, merge=True)
            values = values_of(cfg)
        else:
            values = self.values
            for choice in choices:
                values = _merged(values, choice.key.split("."), choice.value)
        return read(in_proportion({**values, "batch": None}, SimulateSettings), SimulateSettings)


def _merged(values: Any, path: Sequence[str], value: Any) -> Any:
    """A copy of nested mappings in which the value at a path is another; two mappings become one."""
    there = dict(values) if isinstance(values, Mapping) else {}
    if path:
        return there | {path[0]: _merged(there.get(path[0]), path[1:], value)}
    if not isinstance(value, Mapping):
        return value
    for name, entry in value.items():
        there[str(name)] = _merged(there.get(str(name)), (), entry)
    return there


def _parsed(batch: object) -> list[Override]:
    """The overrides of `batch`: a list of them, or one text with blanks between them."""
    if isinstance(batch, str):
        # A blank inside brackets or quotes has no KEY= after it.
        entries = re.split(r"\s+(?=[+~]{0,2}[\w./@:]+=)", batch.strip())
    elif isinstance(batch, ListConfig) and all(isinstance(entry, str) for entry in batch):
        entries = [str(entry) for entry in batch]
    else:
        raise ConfigError(f"batch must be sweeps as on a command line, in a list or in one text, got {batch!r}")
    with _naming("batch"):
        loader = GlobalHydra.instance().config_loader()
        return OverridesParser.create(config_loader=loader).parse_overrides(entries)


def _choices(cfg: DictConfig, override: Override) -> list[Choice]:
    key = override.get_key_element()
    if key.lstrip("+~").startswith("hydra"):
        raise ConfigError(f"batch cannot sweep {key}: its points are computed in one process")
    if override.is_delete():
        return [Choice(str(override.input_line), key.lstrip("~"), None, "", False)]
    if not override.is_sweep_override():
        texts: Iterable[str] = [override.get_value_element_as_str()]
    elif override.is_discrete_sweep():
        texts = override.sweep_string_iterator()
    else:
        raise ConfigError(f"batch needs values to go through, but {override.input_line} is an interval")
    with _naming(str(override.input_line)):
        parser = OverridesParser.create()
        few = list(itertools.islice(texts, MOST + 1))
        if len(few) > MOST:
            raise ConfigError(f"a sweep may have {MOST} points, and {override.input_line} has more")
        return [_choice(cfg, parser.parse_override(f"{key}={text}")) for text in few]


def _choice(cfg: DictConfig, override: Override) -> Choice:
    key = override.get_key_element()
    loader = GlobalHydra.instance().config_loader()
    plain = re.fullmatch(r"[\w.]+", key) is not None and not loader.get_group_options(key)
    line, name = str(override.input_line), key.lstrip("+~")
    value = override.value()
    return Choice(line, name, value, value if isinstance(value, str) else json.dumps(value), plain)


def _quoted(text: str) -> str:
    return '"' + re.sub(r'(\\*)("|$)', lambda m: m[1] * 2 + ('\\"' if m[2] else ""), text) + '"'


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Errors of hydra and OmegaConf as ours, with what they are about."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"{what}: {sentence(error)}") from error
