"""What every bus of servos needs to be told, in SI units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.settings import OURS, PAPER, Settings, setting
from apcc_torch.spread import Numbers, spread

MAX_ID = 252


def check_gains(gains: tuple[int, ...] | None) -> None:
    """Raises ConfigError where gains of a position control are not P, I and D."""
    if gains is not None and (len(gains) != 3 or any(not isinstance(gain, int) for gain in gains)):
        raise ConfigError(f"position_gains must be three whole numbers, P, I and D, got {gains}")


@dataclass(frozen=True, kw_only=True)
class ServoSettings(Settings):
    """Motors, spools and limits. A tendon's entry is at the same place in every list, that of the model's tendons."""

    port: str = setting(meaning="serial device, by a name that stays (/dev/serial/by-id/...)")
    ids: tuple[int, ...] = setting(
        unit="", source=OURS, meaning="on the bus, a motor each tendon", least=0, most=MAX_ID
    )
    spool_radii: Numbers = setting(0.010, "m", OURS, "to the tendon's centre line", above=0, most=0.2)
    signs: Numbers = setting(
        1, "", OURS, "1 where positive rotation lengthens the tendon, -1 where it pulls it in", least=-1, most=1
    )
    lower: Numbers = setting(unit="m", source=PAPER, meaning="of the safe range, which the driver keeps", most=0)
    upper: Numbers = setting(0.0, "m", PAPER, "of the safe range; 0: pulled in only", least=0)
    reply_timeout: float = setting(0.01, "s", OURS, "on top of the time on the line", above=0, most=1)
    zero_tolerance: float = setting(
        2e-3, "m", OURS, "a tendon may be out of its range by this when torque goes on", above=0, most=0.05
    )
    release_torqued: bool = setting(
        False, "", OURS, "connecting lets go of motors that hold torque; false refuses them"
    )

    @property
    def every_id(self) -> tuple[int, ...]:
        """The tendons' motors, and what else is on the bus."""
        return self.ids

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError for a tendon without meaning."""
        ids = self.every_id
        if not self.ids or any(not isinstance(motor, int) for motor in ids) or len(set(ids)) != len(ids):
            raise ConfigError(f"ids must be whole numbers, and differ from each other{self._beside()}, got {list(ids)}")
        if any(sign not in (-1, 1) for sign in self.each("signs")):
            raise ValueRangeError(f"signs must be -1 or 1, got {self.signs}")
        self.each("spool_radii")
        for lower, upper in zip(self.each("lower"), self.each("upper"), strict=True):
            if not lower < upper:
                raise ValueRangeError(f"lower must be below upper, got {lower} and {upper}")

    def _beside(self) -> str:
        """What else ids must differ from, for the message."""
        return ""

    def told_or(self, name: str, of_models: Iterable[float]) -> dict[int, float]:
        """A setting of each tendon's motor by its id; where it is null, what its model has."""
        values = list(of_models) if getattr(self, name) is None else self.each(name)
        return dict(zip(self.ids, values, strict=True))

    def each(self, name: str) -> list[float]:
        """A setting that may be one number for all tendons, as one a tendon."""
        values: list[float] = spread(name, getattr(self, name), len(self.ids)).tolist()
        return values
