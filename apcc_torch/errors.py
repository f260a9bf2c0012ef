"""One exception tree: everything the toolkit refuses is an `ApccError` with a sentence that names the argument."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Self

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


class MismatchError(ConfigError, ValueRangeError):
    """Several values do not fit: the sentence of each, one a line.

    Args:
        errors: Two or more, in order.

    Example:
        >>> try:
        ...     Arm(lengths=[0.2, 0.25], masses=[0.1], sensors=[0.5])
        ... except MismatchError as error:
        ...     print(error)
        sensors must lie on the arm, 0.45 m long, got [0.5]
        masses must have 2 entries, got 1
    """

    def __init__(self, errors: Sequence[ApccError]) -> None:
        self.errors = tuple(errors)
        super().__init__("\n".join(map(str, errors)))

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        return type(self), (self.errors,)


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


def begun_with(head: str, error: ApccError) -> ApccError:
    """The same error with `head` before its sentence, before each of them where it has several."""
    if isinstance(error, MismatchError):
        return MismatchError([begun_with(head, each) for each in error.errors])
    return type(error)(f"{head}{error}")


class Checks:
    """Checks that are all made before what any of them refuses is raised.

    Example:
        >>> checks = Checks()
        >>> for value in (1.0, -1.0, -2.0):
        ...     with checks.one():
        ...         check_setting("mass", value)
        >>> len(checks.errors)
        2
    """

    def __init__(self) -> None:
        self.errors: list[ApccError] = []

    @contextmanager
    def one(self) -> Iterator[None]:
        """Within, one check: what it refuses is kept."""
        try:
            yield
        except MismatchError as several:
            self.errors += several.errors
        except ApccError as error:
            self.errors.append(error)

    def end(self) -> None:
        """Raises what was refused: a single error as it is, several as `MismatchError`, each sentence once."""
        once = list({str(error): error for error in self.errors}.values())
        if len(once) == 1:
            raise once[0]
        if once:
            raise MismatchError(once)


def in_a_line(error: BaseException) -> str:
    """What another library says of an error, as one line of bearable length; its kind where it says nothing."""
    said = getattr(error, "strerror", None) or str(error)
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return lines[0][:300] if lines else type(error).__name__


@contextmanager
def one_sentence(tell: Callable[[str], object]) -> Iterator[None]:
    """Ends a program with `REFUSED` where it refuses what its user can mend: one sentence, no stack."""
    try:
        yield
    except ApccError as error:
        tell(for_terminal(str(error)))
        sys.exit(REFUSED)
