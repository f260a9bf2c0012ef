"""Motor ticks to tendon length changes and back: spool radius, direction, and the calibrated zero."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ShapeError, ValueRangeError

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]

TICKS_PER_TURN = 4096
TICK = 2 * pi / TICKS_PER_TURN  # rad
ROUND_OFF = 1e-9  # ticks: a limit that is a whole tick but for rounding is that tick


@dataclass(frozen=True)
class Spools:
    """All spools: y = sign radius (ticks - zero) 2 pi / 4096.

    radii: (n_a,) m. signs: (n_a,) +1 or -1. lower, upper: (n_a,) m, the range of y. zero: (n_a,) ticks where y is 0.
    farthest: Ticks either way that a motor can be sent to.

    Raises:
        ValueRangeError: A motor cannot reach its whole range from that zero.
    """

    radii: Array
    signs: Ticks
    lower: Array
    upper: Array
    zero: Ticks
    farthest: int

    def __post_init__(self) -> None:
        low, high = self.bounds
        for k in range(len(self.zero)):
            if low[k] < -self.farthest or high[k] > self.farthest:
                raise ValueRangeError(
                    f"tendon {k + 1} would leave the motor's range of {self.farthest} ticks: turn the power off and on"
                )

    @property
    def length_per_tick(self) -> Array:
        """(n_a,) m, with sign."""
        return self.signs * self.radii * TICK

    @property
    def bounds(self) -> tuple[Ticks, Ticks]:
        """Least and greatest ticks (n_a,) whose length is in the range."""
        return self.between(self.lower, self.upper)

    def between(self, lower: Array, upper: Array) -> tuple[Ticks, Ticks]:
        """Least and greatest ticks (n_a,) whose length is from `lower` to `upper` (n_a,), m."""
        ends = np.stack([lower / self.length_per_tick, upper / self.length_per_tick])
        low = np.ceil(ends.min(0) - ROUND_OFF).astype(np.int64)
        high = np.floor(ends.max(0) + ROUND_OFF).astype(np.int64)
        return self.zero + low, self.zero + high

    def length(self, ticks: Ticks) -> Array:
        """Length changes (n_a,), m, at positions (n_a,)."""
        return self.length_per_tick * (ticks - self.zero)

    def rate(self, speed: Array) -> Array:
        """Length rates (n_a,), m/s, at motor speeds (n_a,), rad/s."""
        return self.signs * self.radii * speed

    def tension(self, torque: Array) -> Array:
        """Tensions (n_a,), N, at motor torques (n_a,), N m; positive where the motor pulls the tendon in."""
        return -self.signs * torque / self.radii

    def clip(self, ticks: Ticks) -> Ticks:
        """The nearest positions (n_a,) in the range."""
        return np.clip(ticks, *self.bounds)

    def ticks(self, y: Array) -> Ticks:
        """Positions (n_a,) nearest to length changes y (n_a,), m, in the range.

        Raises:
            ShapeError: y is not (n_a,).
            ValueRangeError: y is not finite.
        """
        y = np.asarray(y, dtype=np.float64)
        if y.shape != self.zero.shape:
            raise ShapeError(f"y must have shape {self.zero.shape}, got {y.shape}")
        if not np.isfinite(y).all():
            raise ValueRangeError(f"y must be finite, got {y.tolist()}")
        # Clipped before it becomes an integer: a huge length would overflow.
        bounded = np.clip(y, self.lower, self.upper)
        return self.clip(self.zero + np.rint(bounded / self.length_per_tick).astype(np.int64))
