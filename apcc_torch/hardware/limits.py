"""The last word on every command: range, rate and step of each tendon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from apcc_torch.errors import SafetyError, ValueRangeError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.model.chambers import ChamberForce
from apcc_torch.settings import OURS, Settings, names, resolved, setting
from apcc_torch.spread import Numbers, spread


@dataclass(frozen=True, kw_only=True)
class CommandLimitSettings(Settings):
    """Clamps of every command: a number, or one a tendon. Length changes are negative where a tendon is pulled in."""

    lower: Numbers = setting(-0.25, "m", OURS, "least length change")
    upper: Numbers = setting(0.25, "m", OURS, "largest length change")
    rate: Numbers = setting(0.25, "m/s", OURS, "largest speed of a command", above=0)
    step: Numbers = setting(0.01, "m", OURS, "between two commands, whatever time has passed", above=0)


@dataclass(frozen=True, kw_only=True)
class PressureLimitSettings(Settings):
    """Clamps of every command to chambers: a number, or one a chamber. Gauge pressures."""

    lower: Numbers | None = setting(None, "Pa", OURS, "least pressure; null: the arm's min_pressure")
    upper: Numbers | None = setting(None, "Pa", OURS, "largest pressure; null: the arm's max_pressure")
    rate: Numbers = setting(4e5, "Pa/s", OURS, "largest rate of a command", above=0)
    step: Numbers = setting(2e4, "Pa", OURS, "between two commands, whatever time has passed", above=0)
    margin: float = setting(
        1e4, "Pa", OURS, "by which a measured pressure may leave the range, or change as regulators are armed", least=0
    )


class CommandLimits:
    """Clamps of tendon length changes y, or of chambers' pressures, which have the same shapes in Pa.

    Attributes:
        lower, upper: (n_a,) m, range of each tendon.
        rate: (n_a,) m/s, largest speed of a command.
        step: (n_a,) m, largest change between two commands, whatever time has passed between them.
        margin: By which a measured pressure may be out of range, Pa; None of lengths, which have others.

    Raises:
        ConfigError: There is neither one number nor one a tendon.
        ValueRangeError: A limit is not finite, a range is empty, or a rate or step is not positive.
    """

    lower: Array
    upper: Array
    rate: Array
    step: Array
    margin: float | None = None

    def __init__(self, n_tendons: int, *given: Any, **changes: Any) -> None:
        settings = resolved(CommandLimitSettings, given, changes)
        for name in names(CommandLimitSettings):
            setattr(self, name, spread(name, getattr(settings, name), n_tendons).numpy())
        if not (np.isfinite(self.lower) & np.isfinite(self.upper) & (self.lower < self.upper)).all():
            raise ValueRangeError(f"lower must be below upper for every tendon, got {self.lower} and {self.upper}")

    @classmethod
    def of_chambers(cls, chambers: ChamberForce, settings: PressureLimitSettings) -> Self:
        """Clamps of the pressures of chambers, never beyond their own.

        Raises:
            ConfigError, ValueRangeError: As of lengths.
        """
        n_a = chambers.area.shape[-1]
        own = {"lower": chambers.least, "upper": chambers.most}
        ends = {
            name: (limit if given is None else spread(name, given, n_a)) for (name, limit), given in
            zip(own.items(), (settings.lower, settings.upper), strict=True)
        }  # fmt: skip
        limits = cls(n_a, **ends, rate=settings.rate, step=settings.step)
        limits.margin = settings.margin
        return limits

    @property
    def what(self) -> str:
        """What they are of, in words."""
        return "lengths" if self.margin is None else "pressures"

    def shown(self, value: Array | float) -> str:
        """Values in the unit in which people read them."""
        scale, unit, digits = (1e3, "mm", 2) if self.margin is None else (1e-3, "kPa", 1)
        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64)) * scale
        told = [round(float(number), digits) for number in numbers]
        return f"{told[0] if np.ndim(value) == 0 else told} {unit}"

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
