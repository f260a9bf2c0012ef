"""Where the simulated arm is: in lockstep with a virtual clock; `process` has the one in real time."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from apcc_torch.errors import ConfigError, HardwareError
from apcc_torch.hardware.clock import Clock, VirtualClock
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.hardware.simulated.board import Board, Mode, board_type
from apcc_torch.hardware.world import World
from apcc_torch.settings import OURS, Settings, setting


class SimulatedWorld(World):
    """One arm, opened by its actuator or its sensor, whichever comes first, and closed by the last of them."""

    def __init__(self, arm: SimulatedArm, clock: Clock) -> None:
        self.arm = arm
        self.clock = clock
        self.board = Board(np.zeros((), board_type(arm.n_tendons, arm.n_bodies, arm.n)))
        self.users: set[str] = set()

    def open(self, user: str) -> None:
        """Begins the arm's time, if it has not begun."""
        if not self.users:
            self._begin()
        self.users.add(user)

    def close(self, user: str) -> None:
        """Ends it with the last user. Safe to call in any state."""
        was_open = bool(self.users)
        self.users.discard(user)
        if was_open and not self.users:
            self._finish()

    @property
    def is_open(self) -> bool:
        """Whether the arm's time runs."""
        return bool(self.users)

    def metrics(self) -> dict[str, float]:
        """How much time passed without the arm, because it could not be computed in time."""
        return {"simulated_arm_behind_s": float(self.board.memory["slip"])}

    def true_coordinates(self, sequence: int) -> Array | None:
        """See `World`."""
        try:
            with self.locked() as board:
                return board.coordinates(sequence)
        except HardwareError:
            return None

    @abstractmethod
    def _begin(self) -> None: ...

    @abstractmethod
    def _finish(self) -> None: ...

    @abstractmethod
    def locked(self) -> AbstractContextManager[Board]:
        """A context with the board, nobody else writing to it.

        Raises:
            HardwareError: The arm is gone.
        """


def simulated(world: World) -> SimulatedWorld:
    """The world, for a device that needs a simulated arm in it.

    Raises:
        ConfigError: There is none.
    """
    if not isinstance(world, SimulatedWorld):
        raise ConfigError(f"a simulated device needs a simulated arm, and there is none in {type(world).__name__}")
    return world


@dataclass(frozen=True, kw_only=True)
class LockstepSettings(Settings):
    """How finely the simulated arm is stepped."""

    step: float = setting(5e-3, "s", OURS, "step of the plant; one takes about half of that to compute", above=0)


class LockstepWorld(SimulatedWorld):
    """The arm follows a virtual clock: a run is the same every time, and as fast as it can be computed.

    Args:
        arm: The arm.
        clock: The run's.
    """

    settings_type = LockstepSettings

    def __init__(self, arm: SimulatedArm, clock: VirtualClock) -> None:
        super().__init__(arm, clock)
        self.virtual = clock

    @classmethod
    def around(cls, settings: LockstepSettings, arm: Callable[[float], SimulatedArm]) -> Self:
        """The world of an arm, at the beginning of its time."""
        return cls(arm(settings.step), VirtualClock())

    def _begin(self) -> None:
        with torch.inference_mode():
            self.board = Board(np.zeros((), board_type(self.arm.n_tendons, self.arm.n_bodies, self.arm.n)))
            self.arm.begin(self.clock.now, self.board)
        self.virtual.followers.append(self._follow)
        self._follow(self.clock.now())

    def _follow(self, time: float) -> None:
        with torch.inference_mode():
            # A step ahead, as in real time: a reader finds a knot on either side.
            while self.arm.time < time + self.arm.step:
                memory = self.board.memory
                self.arm.advance(self.board, memory["goal"].copy(), Mode(int(memory["mode"])))

    def _finish(self) -> None:
        self.virtual.followers.remove(self._follow)

    @contextmanager
    def locked(self) -> Iterator[Board]:
        """A context with the board."""
        yield self.board
