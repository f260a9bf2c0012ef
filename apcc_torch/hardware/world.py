"""Where the devices of a run are: in the real world, or around a simulated arm; each with its own clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from apcc_torch.hardware.clock import Clock, MonotonicClock
from apcc_torch.part import Configurable
from apcc_torch.settings import OURS, Settings, setting


@dataclass(frozen=True, kw_only=True)
class RealTimeSettings(Settings):
    """How deadlines are kept in real time."""

    spin: float = setting(2e-4, "s", OURS, "before a deadline, when the loop wakes and spins", least=0)


class World(Configurable, ABC):
    """What the devices of a run share.

    Attributes:
        clock: Of every stamp.
    """

    clock: Clock

    @classmethod
    @abstractmethod
    def around(cls, settings: Any, arm: Callable[[float], Any]) -> Self:
        """The world that settings describe.

        Args:
            settings: Of this class.
            arm: Makes the simulated arm that is stepped by so many s; a world that is real does not call it.
        """

    def metrics(self) -> dict[str, float]:
        """What it adds to a run's metrics once the run is over."""
        return {}

    def true_coordinates(self, sequence: int) -> NDArray[np.float64] | None:
        """(n,) of the true arm as a frame of the sensors was measured; None where nobody knows them."""
        return None


class RealWorld(World):
    """Real devices, which need nothing of each other, on the machine's own clock."""

    settings_type = RealTimeSettings

    def __init__(self, settings: RealTimeSettings) -> None:
        self.clock = MonotonicClock(settings.spin)

    @classmethod
    def around(cls, settings: RealTimeSettings, arm: Callable[[float], Any]) -> Self:
        """The world, without any simulated arm."""
        return cls(settings)
