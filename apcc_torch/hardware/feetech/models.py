"""The models of the STS series: what models.yaml says of each, by its number."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

from apcc_torch.hardware.servos.known_model import known_model
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN

FILE = Path(__file__).with_name("models.yaml")
MARGIN = 1.25  # of the no-load speed: supplies above their nominal voltage, and readings that are not evenly spaced


class Model(NamedTuple):
    """One model.

    number: What the motor says it is. speed: rev/min without load. torque: N m/A at the output.
    """

    number: int
    name: str
    speed: float
    torque: float

    @property
    def fastest(self) -> float:
        """Ticks/s that it does not reach."""
        return MARGIN * self.speed / 60 * TICKS_PER_TURN


@cache
def models() -> dict[int, Model]:
    """All known models by their number."""
    rows = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return {number: Model(number, **row) for number, row in rows.items()}


def model_of(number: float) -> Model:
    """The model of a number.

    Raises:
        ConfigError: It is not known.
    """
    return known_model(models(), number)
