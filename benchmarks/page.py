"""Tables in pages: what stands between two marks is written by a program."""

from __future__ import annotations


def between(text: str, begin: str, end: str, table: str) -> str:
    """The page with the table between its marks.

    Args:
        text: The page, each mark in it once.
        begin, end: The marks.
        table: Markdown.
    """
    head, rest = text.split(begin)
    return f"{head}{begin}\n{table}\n{end}{rest.split(end)[1]}"
