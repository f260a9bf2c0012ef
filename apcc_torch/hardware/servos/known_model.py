"""A servo's model by the number that it tells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, TypeVar

from apcc_torch.errors import ConfigError


class Numbered(Protocol):
    """A model: its number, and what the maker calls it."""

    @property
    def number(self) -> int: ...
    @property
    def name(self) -> str: ...


M = TypeVar("M", bound=Numbered)


def known_model(known: Mapping[int, M], number: float) -> M:
    """The model of a number.

    Raises:
        ConfigError: It is not known.
    """
    if number not in known:
        names = ", ".join(f"{each.number} ({each.name})" for each in known.values())
        raise ConfigError(f"model_number must be one of {names}, got {number:g}")
    return known[round(number)]
