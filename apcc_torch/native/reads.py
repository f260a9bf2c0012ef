"""Which settings a function reads while it is traced: a description that it only holds has no part in its code."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from apcc_torch.settings import Settings


@contextmanager
def reads_of(described: Sequence[Settings]) -> Iterator[set[int]]:
    """Notes which of these settings have an attribute read inside, by their numbers; other threads' reads count too."""
    numbers = {id(each): number for number, each in enumerate(described)}
    read: set[int] = set()

    def noting(self: Settings, name: str) -> Any:
        number = numbers.get(id(self))
        if number is not None:
            read.add(number)
        return before(self, name)

    before: Any = Settings.__getattribute__
    Settings.__getattribute__ = noting  # type: ignore[method-assign, assignment]
    try:
        yield read
    finally:
        Settings.__getattribute__ = before  # type: ignore[method-assign]
