"""The keys of a command as a table for `--help`: name, value, unit, source, meaning."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from apcc_torch.composition.schema import typed
from apcc_torch.errors import ApccError
from apcc_torch.part import part_of
from apcc_torch.settings import Settings, about_of, keys

WIDTH = 118


class Row(NamedTuple):
    """One key: its dotted name, its value as text, its unit, where its default comes from, what it means."""

    key: str
    value: str
    unit: str
    source: str
    meaning: str


def rows(settings: Settings, prefix: str = "") -> Iterator[Row]:
    """Every key of settings, group by group; a group's own row says what it is."""
    for each in keys(type(settings)):
        value, about, key = getattr(settings, each.name), about_of(each), f"{prefix}{each.name}"
        if isinstance(value, Settings):
            kind = f"{part_of(value).__name__}" if about.base is not None else ""
            yield Row(key, kind, "", "", about.meaning)
            yield from rows(value, f"{key}.")
        else:
            yield Row(key, _shown(value), about.unit, about.source, about.meaning)


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_shown(entry) for entry in value)}]"
    return str(value)


def table(settings: Settings) -> str:
    """The keys as text, one a line."""
    lines = []
    for row in rows(settings):
        depth = row.key.count(".")
        if not row.source:
            lines += ["", f"{'  ' * depth}{row.key}  {row.value}".rstrip() + f"   {row.meaning}"]
            continue
        value = textwrap.shorten(row.value, 34, placeholder=" …")
        unit = f" {row.unit}" if row.unit else ""
        head = f"{'  ' * depth}{row.key}={value}{unit}"
        words = f"[{row.source}] {row.meaning}"
        lines += [
            f"{head:<52} {line}" if i == 0 else f"{'':<52} {line}" for i, line in enumerate(_wrapped(words, head))
        ]
    return "\n".join(lines)


def _wrapped(words: str, head: str) -> list[str]:
    return textwrap.wrap(words, max(40, WIDTH - max(53, len(head) + 1)))


def settings_text(root: type[Settings], cfg: DictConfig) -> str:
    """The keys of the settings that a composed configuration means; of one that means none, why not."""
    try:
        return table(typed(cfg, root))
    except ApccError as error:
        return f"These settings do not fit: {error}\n\n{OmegaConf.to_yaml(cfg)}"
