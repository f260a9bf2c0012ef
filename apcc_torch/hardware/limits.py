"""The last word on every command: range, rate and step of each tendon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from apcc_torch.errors import SafetyError, ValueRangeError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.settings import OURS, Settings, names, resolved, setting
from apcc_torch.spread import Numbers, spread


@dataclass(frozen=True, kw_only=True)
class CommandLimitSettings(Settings):
    """Clamps of every command: a number, or one a tendon. Length changes are negative where a tendon is pulled in."""

    lower: Numbers = setting(-0.25, "m", OURS, "least length change")
    upper: Numbers = setting(0.25, "m", OURS, "largest length change")
    rate: Numbers = setting(0.25, "m/s", OURS, "largest speed of a command", above=0)
    step: Numbers = setting(0.01, "m", OURS, "between two commands, whatever time has passed", above=0)


class CommandLimits:
    """Clamps of tendon length changes y.

    Args:
        n_tendons: Number of tendons n_a.
        given, changes: Settings.

    Attributes:
        lower, upper: (n_a,) m, range of each tendon.
        rate: (n_a,) m/s, largest speed of a command.
        step: (n_a,) m, largest change between two commands, whatever time has passed between them.

    Raises:
        ConfigError: There is neither one number nor one a tendon.
        ValueRangeError: A limit is not finite, a range is empty, or a rate or step is not positive.
    """

    lower: Array
    upper: Array
    rate: Array
    step: Array

    def __init__(self, n_tendons: int, *given: Any, **changes: Any) -> None:
        settings = resolved(CommandLimitSettings, given, changes)
        for name in names(CommandLimitSettings):
            setattr(self, name, spread(name, getattr(settings, name), n_tendons).numpy())
        if not (np.isfinite(self.lower) & np.isfinite(self.upper) & (self.lower < self.upper)).all():
            raise ValueRangeError(f"lower must be below upper for every tendon, got {self.lower} and {self.upper}")

    def inside(self, y: Array, margin: float = 0.0) -> bool:
        """Whether lengths (n_a,) m are in their range, widened by `margin` m."""
        return bool(((y >= self.lower - margin) & (y <= self.upper + margin)).all())

    def nearest(self, y: Array) -> Array:
        """The lengths (n_a,) m in range that are nearest to y."""
        return np.clip(y, self.lower, self.upper)

    def clamp(self, y: Array, *standing: tuple[Array, float]) -> tuple[Array, Array, Array]:
        """What may be sent of a wanted command.

        Args:
            y: (n_a,) wanted, m.
            standing: What the motors may have been told before, (n_a,) m, each with the time since then, s.

        Returns:
            The nearest that may be sent, and the least and the greatest that may, (n_a,) m each: in range, and no
            farther from each of `standing` than rate and step allow, except back into range.

        Raises:
            SafetyError: y or one of `standing` is not finite.
        """
        low, high = self.lower, self.upper
        for last, elapsed in standing:
            if not (np.isfinite(y).all() and np.isfinite(last).all()):
                raise SafetyError(f"a command must be finite, got {y} after {last}")
            reach = np.minimum(self.rate * max(elapsed, 0.0), self.step)
            low, high = np.maximum(low, self.nearest(last - reach)), np.minimum(high, self.nearest(last + reach))
        return np.clip(y, low, high), low, high
