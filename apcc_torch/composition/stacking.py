"""Settings of many runs as one: what differs between runs that can share a tensor batch becomes a number a run."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.classes import name_of
from apcc_torch.composition.build import DTYPES
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.gain import gain_matrix
from apcc_torch.part import part_of
from apcc_torch.settings import About, Settings, about_of
from apcc_torch.spread import is_profile, spread

Path = tuple[str, ...]


class Point(NamedTuple):
    """One run of a batch.

    number: Its number, in the order of a multirun over the same keys.
    settings: {swept key: value}, as text.
    config: All its settings.
    """

    number: int
    settings: dict[str, str]
    config: SimulateSettings


def structure(config: SimulateSettings) -> Hashable:
    """What runs must have in common to share a tensor batch: all but the numbers that may differ by row."""
    n = config.arm.n_sections
    return tuple((path, _form(about, value, n)) for path, about, value in leaves(config))


def stacked(configs: Sequence[SimulateSettings]) -> SimulateSettings:
    """The settings of runs of one `structure`, for `Builder(..., points=len(configs))`.

    Where all agree, a value stays as it is. Where they differ, it becomes a tensor: (P, 1) of P numbers, (P, 1, n) of P
    lists of n, (P, 1, n, n) of P gains, (P, S, 3) of P lists of set-points.
    """
    first = configs[0]
    dtype, device = DTYPES[first.dtype], torch.device(first.device)
    changes: dict[Path, Tensor] = {}
    for entries in zip(*(leaves(config) for config in configs), strict=True):
        path, about, value = entries[0]
        values = [entry[2] for entry in entries]
        if about.rows and any(other != value for other in values[1:]):
            tensors = [_tensor(path, about, each, first.arm.n_sections) for each in values]
            rows = torch.stack(tensors).to(device)
            rows = rows if rows.dtype == torch.int64 else rows.to(dtype)
            changes[path] = rows if about.rows == "points" else rows.unsqueeze(1)
    return _replaced(first, changes)


def _tensor(path: Path, about: About, value: Any, n_sections: int) -> Tensor:
    key = ".".join(path)
    if about.rows in ("gain", "task"):
        return gain_matrix(key, value, n_sections if about.rows == "gain" else 3)
    if _is_spread(about, value):
        return spread(key, value, n_sections)
    return torch.tensor(value, dtype=torch.int64 if isinstance(value, int) else torch.float64)


def _is_spread(about: About, value: Any) -> bool:
    """Whether a value stands for one number a section without naming them."""
    return about.rows == "sections" and (isinstance(value, float | int) or is_profile(value))


def leaves(settings: Settings, path: Path = ()) -> Iterator[tuple[Path, About, Any]]:
    """(path, what is known, value) of every setting; a part that is named by its class has a leaf "kind" too."""
    for each in fields(settings):
        value, about, at = getattr(settings, each.name), about_of(each), (*path, each.name)
        if isinstance(value, Settings):
            if about.base is not None:
                yield (*at, "kind"), About(), name_of(part_of(value))
            yield from leaves(value, at)
        else:
            yield at, about, value


def _replaced(settings: Settings, changes: Mapping[Path, Tensor], path: Path = ()) -> Any:
    values = {}
    for each in fields(settings):
        value, at = getattr(settings, each.name), (*path, each.name)
        if isinstance(value, Settings):
            later = _replaced(value, changes, at)
            if later is not value:
                values[each.name] = later
        elif at in changes:
            values[each.name] = changes[at]
    return replace(settings, **values) if values else settings


def _form(about: About, value: Any, n_sections: int) -> Hashable:
    if about.rows and value is not None:
        if about.rows in ("gain", "task"):
            return about.rows
        if about.apart:
            return bool(value > 0)
        sizes = (n_sections,) if _is_spread(about, value) else _sizes(value)
        if sizes is not None:
            return sizes
    return repr(value)


def _sizes(value: Any) -> tuple[int, ...] | None:
    """() of a number, (n,) of a list of numbers, (S, n) of a list of such lists; None of anything else."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return ()
    if isinstance(value, list | tuple):
        inner = {_sizes(entry) for entry in value}
        if len(inner) == 1 and None not in inner:
            (sizes,) = inner
            return (len(value), *sizes)  # type: ignore[misc]
    return None
