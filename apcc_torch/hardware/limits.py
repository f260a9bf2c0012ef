"""The last word on every command: range, rate and step of each tendon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apcc_torch.errors import SafetyError, ValueRangeError
from apcc_torch.hardware.interfaces import Array


@dataclass(frozen=True)
class CommandLimits:
    """Clamps of tendon length changes y, each (n_a,).

    lower, upper: m, range of each tendon.
    rate: m/s, largest speed of a command.
    step: m, largest change between two commands, whatever time has passed between them.

    Raises:
        ValueRangeError: A limit is not finite, a range is empty, or a rate or step is not positive.
    """

    lower: Array
    upper: Array
    rate: Array
    step: Array

    def __post_init__(self) -> None:
        """Checks the limits."""
        for name in ("lower", "upper", "rate", "step"):
            if not np.isfinite(getattr(self, name)).all() or getattr(self, name).shape != self.lower.shape:
                raise ValueRangeError(f"{name} must hold one finite number a tendon, got {getattr(self, name)}")
        if not (self.lower < self.upper).all():
            raise ValueRangeError(f"lower must be below upper for every tendon, got {self.lower} and {self.upper}")
        if not ((self.rate > 0).all() and (self.step > 0).all()):
            raise ValueRangeError(f"rate and step must be positive, got {self.rate} and {self.step}")

    def inside(self, y: Array, margin: float = 0.0) -> bool:
        """Whether lengths (n_a,) m are in their range, widened by `margin` m."""
        return bool(((y >= self.lower - margin) & (y <= self.upper + margin)).all())

    def nearest(self, y: Array) -> Array:
        """The lengths (n_a,) m in range that are nearest to y."""
        return np.clip(y, self.lower, self.upper)

    def clamp(self, y: Array, last: Array, elapsed: float) -> Array:
        """What may be sent of a wanted command.

        Args:
            y: (n_a,) wanted, m.
            last: (n_a,) what was sent before, m.
            elapsed: Time since then, s.

        Returns:
            (n_a,) m: in range, and no farther from `last` than rate and step allow, except back into range.

        Raises:
            SafetyError: y or last is not finite.
        """
        if not (np.isfinite(y).all() and np.isfinite(last).all()):
            raise SafetyError(f"a command must be finite, got {y} after {last}")
        reach = np.minimum(self.rate * max(elapsed, 0.0), self.step)
        return np.clip(np.clip(y, last - reach, last + reach), self.lower, self.upper)
