"""Progress bars, of one size on every terminal that does not say its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import Any, TextIO

from tqdm import tqdm

COLUMNS, LINES = 80, 24
"""Of a terminal that says zero, as many do in containers and over serial lines: tqdm would draw nothing."""


def size_of(file: TextIO) -> dict[str, Any]:
    """What tqdm is told of the size of a file's terminal."""
    try:
        size = os.get_terminal_size(file.fileno())
    except (OSError, ValueError):  # it is none
        return {"ncols": COLUMNS, "nrows": LINES}
    return {"dynamic_ncols": True} if size.columns and size.lines else {"ncols": COLUMNS, "nrows": LINES}


def terminal_bar(
    items: Iterable[Any] | None = None, *, shown: bool = True, file: TextIO | None = None, **look: Any
) -> Any:
    """A bar over items, or one to be moved by hand; none where there is no terminal.

    Args:
        items: What to go through; None for a bar of `total` steps.
        shown: Whether it is wanted.
        file: Where to draw; None: standard error.
        look: Of tqdm: desc, total, unit, leave, position, bar_format.
    """
    file = sys.stderr if file is None else file
    return tqdm(items, file=file, disable=None if shown else True, **{"leave": False, **size_of(file), **look})
