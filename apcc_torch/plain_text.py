"""Text that came from a file or a device, made harmless before a terminal or a spreadsheet shows it."""

from __future__ import annotations

import logging
import re
import unicodedata

KEPT = "\n\t"
"""Controls that only lay text out."""
HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode's categories of what acts rather than shows: controls, marks of direction, halves of pairs."""
FORMULA = re.compile(r"[\t\r\n]|[\s\x00-\x1f\x7f-\x9f]*[=+\-@\uff1d\uff0b\uff0d\uff20]")
"""How a cell begins that a spreadsheet may carry out."""


def for_terminal(text: str) -> str:
    r"""Text in which controls are written out: a terminal shows it and does nothing else.

    Line feeds and tabs stay. Everything else that acts without showing (escape sequences, the bell, carriage returns,
    marks that reverse the direction of writing, lone halves of pairs, which cannot be printed) becomes Python's escape.

    Example:
        >>> print(for_terminal("\x1b[2Jarm\u202e"))
        \x1b[2Jarm\u202e
    """
    if text.isprintable():
        return text
    return "".join(c if c in KEPT or unicodedata.category(c) not in HIDDEN else ascii(c)[1:-1] for c in text)


def plain_logger(name: str) -> logging.Logger:
    """The logger of a module of the package: its lines act on no terminal, whoever formats them."""
    log = logging.getLogger(name)
    log.addFilter(_made_plain)  # once, however often
    return log


def _made_plain(record: logging.LogRecord) -> bool:
    record.msg, record.args = for_terminal(record.getMessage()), ()
    return True


class PlainFormatter(logging.Formatter):
    """Lines of a log whose text acts on no terminal; the programs' logging is set to it, in conf/."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        return for_terminal(super().format(record))


def for_spreadsheet(text: str) -> str:
    """Text of a cell that no spreadsheet takes for a formula: an apostrophe stands before what looks like one.

    A number stays as it is, with its sign.

    Example:
        >>> for_spreadsheet("=1+1"), for_spreadsheet("-0.5"), for_spreadsheet("kinematic")
        ("'=1+1", '-0.5', 'kinematic')
    """
    return f"'{text}" if FORMULA.match(text) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.strip() == text
