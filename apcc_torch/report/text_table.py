"""Lines of cells as a table in plain text, or in Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells with their columns aligned; the first line is that of the titles.

    Example:
        >>> print(aligned([["law", "mm"], ["fixed", "3.3"]]))
        law    mm
        fixed  3.3
    """
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def as_markdown(lines: Sequence[Sequence[str]]) -> str:
    """The same as a table of Markdown.

    Example:
        >>> print(as_markdown([["law", "mm"], ["fixed", "3.3"]]))
        | law | mm |
        |---|---|
        | fixed | 3.3 |
    """
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, "|---" * len(lines[0]) + "|", *body])
