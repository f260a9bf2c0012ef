"""Numbers as people give them, "0.2", "200mm" or "1.2 MPa", and whether they read as another unit than is meant."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from apcc_torch.errors import ConfigError, ValueRangeError

PREFIXES = {"": 1.0, "G": 1e9, "M": 1e6, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6}


class Unit(NamedTuple):
    """What a number is in.

    symbol: Of the file, "m". named: "metres". prefixes: Those that are known before `base`. least, most: What a number
    without a unit is believed to be from and to. other: The unit that is meant beyond `most`, or below `least`.
    base: What prefixes stand before, and what one of it is in `symbol`.
    """

    symbol: str
    named: str
    prefixes: str
    least: float
    most: float
    other: str
    base: tuple[str, float]


LENGTH = Unit("m", "metres", "mcu", 1e-3, 5.0, "mm", ("m", 1.0))
WIDTH = Unit("m", "metres", "mcu", 1e-4, 0.5, "mm", ("m", 1.0))
MASS = Unit("kg", "kilograms", "km", 1e-3, 100.0, "g", ("g", 1e-3))
PRESSURE = Unit("Pa", "pascals", "kMG", 1e3, 1e13, "MPa", ("Pa", 1.0))


def quantity(name: str, text: str, unit: Unit, zero: bool = False) -> float:
    """The number that a text gives, in the unit's symbol.

    Args:
        name: What it is of, for messages.
        text: A number; a unit may follow it.
        unit: What it is in where none does.
        zero: Whether it may be zero.

    Raises:
        ConfigError: It is no number, or its unit is none of these.
        ValueRangeError: It is not positive, or reads as a number in another unit.

    Example:
        >>> quantity("--offset", "15 mm", WIDTH), quantity("--mass", "0.4", MASS)
        (0.015, 0.4)
    """
    found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Z]*)\s*", text)
    if found is None:
        raise ConfigError(f"{name} must be a number in {unit.named}, such as {_shown(unit.most / 10)}, got {text!r}")
    number, given = float(found[1]), found[2]
    factor = 1.0 if given in ("", unit.symbol) else _factor(name, given, unit)
    value = float(f"{number * factor:.12g}")
    if not (value > 0 or (zero and value == 0)) or not math.isfinite(value):
        raise ValueRangeError(f"{name} must be {'zero or ' if zero else ''}positive, got {text}")
    if not given and value and not unit.least <= value <= unit.most:
        meant = value * _factor(name, unit.other, unit)
        raise ValueRangeError(
            f"{name} is in {unit.named}, and {text.strip()} reads as {unit.other}: give {_shown(meant)}, "
            f"or {text.strip()}{unit.other}; {text.strip()}{unit.symbol} where it is meant so"
        )
    return value


def _factor(name: str, given: str, unit: Unit) -> float:
    symbol, size = unit.base
    prefix = given.removesuffix(symbol)
    if given.endswith(symbol) and (not prefix or prefix in unit.prefixes) and prefix in PREFIXES:
        return PREFIXES[prefix] * size
    known = ", ".join(dict.fromkeys([unit.symbol, *(f"{prefix}{symbol}" for prefix in ("", *unit.prefixes))]))
    raise ConfigError(f"{name} has the unit {given!r}, and can have {known}")


def _shown(value: float) -> str:
    return f"{value:.6g}"
