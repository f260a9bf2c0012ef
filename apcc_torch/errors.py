"""One exception tree: everything the toolkit refuses is an `ApccError` with a sentence that names the argument."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apcc_torch.plain_text import for_terminal

REFUSED = 2
"""The exit code of a program that refuses what its user can mend."""


class ApccError(Exception):
    """Base of every error the toolkit raises on purpose.

    Example:
        >>> try:
        ...     PCCBackbone(0)
        ... except ApccError as error:
        ...     print(error)
        n_sections must be at least 1, got 0
    """


class ShapeError(ApccError, ValueError):
    """A tensor has the wrong shape, or shapes that do not broadcast."""


class DtypeError(ApccError, TypeError):
    """An argument is not a floating-point tensor, or dtypes are mixed."""


class ValueRangeError(ApccError, ValueError):
    """A value is outside its range: not finite, not positive, not sorted, not positive definite."""


class ConfigError(ApccError, ValueError):
    """A configuration names an unknown key, an unknown choice, or a value of the wrong type."""


class DataError(ApccError, ValueError):
    """A recording or a run folder is missing, truncated or not in the documented layout."""


class WriteError(ApccError, OSError):
    """A file cannot be written: the disk is full, the folder is another user's, a folder has its name."""


class HardwareError(ApccError, RuntimeError):
    """A device is missing, is not the one configured, does not answer, or reports a fault."""


class CommunicationError(HardwareError):
    """A packet was lost, late, short or corrupt, or the connection is gone."""


class DeviceFaultError(HardwareError):
    """The device answers, and says that it has failed: overload, heat, a tripped watchdog."""


class SafetyError(HardwareError):
    """A guard of the runner was violated: it stops rather than going on."""


class CompileError(ApccError, RuntimeError):
    """A function cannot be compiled: it cannot be traced, uses an operation without a rule, or no compiler is there."""


class GradientError(ApccError, RuntimeError):
    """A derivative was asked for that is not provided."""


def in_a_line(error: BaseException) -> str:
    """What another library says of an error, as one line of bearable length; its kind where it says nothing."""
    said = getattr(error, "strerror", None) or str(error)
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return lines[0][:300] if lines else type(error).__name__


@contextmanager
def one_sentence(tell: Callable[[str], object]) -> Iterator[None]:
    """Ends a program with `REFUSED` where it refuses what its user can mend: one sentence, no stack.

    Args:
        tell: What takes the sentence.
    """
    try:
        yield
    except ApccError as error:
        tell(for_terminal(str(error)))
        sys.exit(REFUSED)
