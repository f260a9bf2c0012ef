"""What regulators on Modbus TCP need to be told: addresses, units, limits and their watchdog."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.settings import OURS, Settings, setting
from apcc_torch.spread import Numbers, spread

LAST = 65535
"""Of addresses and of what a register holds."""


@dataclass(frozen=True, kw_only=True)
class RegulatorSettings(Settings):
    """Regulators behind one Modbus TCP server. A chamber has the same place in every list as in the arm."""

    host: str = setting(meaning="address of the server, a name or an IP address")
    port: int = setting(502, "", OURS, "its TCP port", least=1, most=LAST)
    units: tuple[int, ...] = setting(
        (1,), "", OURS, "unit id of each chamber's regulator; one for all", least=0, most=247
    )
    commands: tuple[int, ...] = setting(
        unit="", source=OURS, meaning="holding register of each chamber's commanded pressure", least=0, most=LAST
    )
    readings: tuple[int, ...] = setting(
        unit="", source=OURS, meaning="register of each chamber's measured pressure", least=0, most=LAST
    )
    reading_table: str = setting(
        "input", "", OURS, "which registers hold measured pressures and status", choices=("input", "holding")
    )
    command_scale: Numbers = setting(10.0, "Pa", OURS, "of one count of a command", above=0)
    reading_scale: Numbers = setting(10.0, "Pa", OURS, "of one count of a measured pressure", above=0)
    lower: Numbers = setting(0.0, "Pa", OURS, "least pressure, which the driver keeps", least=0)
    upper: Numbers = setting(unit="Pa", source=OURS, meaning="largest pressure, which the driver keeps", above=0)
    enable: int | None = setting(
        None,
        "",
        OURS,
        "holding register that is 1 while outputs follow commands; null: they always do",
        least=0,
        most=LAST,
    )
    watchdog: float | None = setting(
        0.2, "s", OURS, "without a request, after which a unit vents by itself; null: none is set", above=0, most=60
    )
    watchdog_register: int | None = setting(
        None, "", OURS, "holding register of that time; null: the unit is set up otherwise", least=0, most=LAST
    )
    watchdog_unit: float = setting(1e-3, "s", OURS, "of one count of that time", above=0, most=60)
    heartbeat: int | None = setting(
        None, "", OURS, "holding register that counts up with every command; null: none", least=0, most=LAST
    )
    status: int | None = setting(None, "", OURS, "register of a unit's faults; null: none", least=0, most=LAST)
    faults: int = setting(LAST, "", OURS, "bits of it that are faults", least=1, most=LAST)
    identity: int | None = setting(
        None, "", OURS, "register that tells the kind of unit; null: none", least=0, most=LAST
    )
    kind_number: int = setting(0, "", OURS, "what has to be in it", least=0, most=LAST)
    reply_timeout: float = setting(0.05, "s", OURS, "to wait for a reply", above=0, most=10)
    settle_tolerance: float = setting(
        2e3, "Pa", OURS, "by which a pressure may be out of its range when regulators are armed", least=0
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError for a chamber without meaning."""
        n_a = len(self.commands)
        if not n_a or len(self.readings) != n_a:
            raise ConfigError(f"readings must have {n_a} entries, as commands have, and at least one")
        if len(self.units) not in (1, n_a):
            raise ConfigError(f"units must have one entry, or {n_a}, one a chamber, got {len(self.units)}")
        for name in ("commands", "readings"):
            places = list(zip(self.each_unit(), getattr(self, name), strict=True))
            if len(set(places)) != n_a:
                raise ConfigError(
                    f"{name} must be another register for every chamber of a unit, got {getattr(self, name)}"
                )
        lower, upper = self.each("lower"), self.each("upper")
        if not bool((lower < upper).all()):
            raise ValueRangeError(f"lower must be below upper for every chamber, got {self.lower} and {self.upper}")
        if bool((upper / self.each("command_scale") > LAST).any()):
            raise ValueRangeError("upper over command_scale must fit a register of 16 bits, 65535 counts")
        if self.watchdog is not None and self.watchdog_register is not None:
            counts = round(self.watchdog / self.watchdog_unit)
            if not 1 <= counts <= LAST:
                raise ValueRangeError(f"watchdog must be from 1 to {LAST} of watchdog_unit, got {counts}")

    def each(self, name: str) -> Tensor:
        """A setting that may be one number for all chambers, as one a chamber (n_a,)."""
        return spread(name, getattr(self, name), len(self.commands))

    def each_unit(self) -> tuple[int, ...]:
        """The unit id of each chamber's regulator."""
        return self.units * len(self.commands) if len(self.units) == 1 else self.units
