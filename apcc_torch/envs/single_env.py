"""One arm as a Gymnasium `Env` of numpy arrays: one row of the batch, the same code."""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.annotations import shown
from apcc_torch.envs.outcome import TruncatedReason
from apcc_torch.envs.vector_env import ArmVectorEnv
from apcc_torch.errors import ConfigError, DtypeError

Observation = NDArray[np.float32]


class ArmEnv(gymnasium.Env[Observation, Observation]):
    """One row of an `ArmVectorEnv`; the time limit is that of Gymnasium's wrapper, and `truncated_reason` tells it too.

    Args:
        render_mode: "rgb_array", "human" for a page in the browser, or None.
        **settings: Those of `ArmVectorEnv`, but num_envs, autoreset_mode and render_mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector: ClassVar[type[ArmVectorEnv]]

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ConfigError(
                f"render_mode must be one of {', '.join(self.metadata['render_modes'])}, got {render_mode!r}"
            )
        self.render_mode = render_mode
        self.batch = self.vector(1, autoreset_mode="DISABLED", **settings)
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.time_limit: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a new episode; row 0 of the batch with the same seed."""
        super().reset(seed=seed)
        self.time_limit = _time_limit(self)
        observation, info = self.batch.reset(seed=seed)
        return observation[0].cpu().numpy(), _plain(info)

    def step(self, action: Observation) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control period."""
        try:
            given = torch.as_tensor(np.asarray(action, dtype=np.float32)).unsqueeze(0)
        except (TypeError, ValueError) as error:
            raise DtypeError(f"action must be numbers, got {shown(action)}") from error
        observation, reward, terminated, truncated, info = self.batch.step(given)
        told = _plain(info)
        if self.time_limit is not None and self.batch.state is not None and not told["truncated_reason"]:
            told["truncated_reason"] = int(TruncatedReason.TIME_LIMIT) * (int(self.batch.state.step) >= self.time_limit)
        plain = observation[0].cpu().numpy(), float(reward), bool(terminated), bool(truncated), told
        if self.render_mode == "human":
            self.render()
        return plain

    def render(self) -> NDArray[Any] | None:
        """The picture (H, W, 3) uint8; None where it is shown on a page, or without a render mode."""
        if self.render_mode is None:
            return None
        picture = self.batch.picture(0)
        if self.render_mode == "human":
            self.batch.window().show(picture, self.batch.simulator.period)
            return None
        return self.batch.drawing().frame(picture)

    def close(self) -> None:
        """Closes the page, if there is one."""
        self.batch.close()


def _time_limit(env: ArmEnv) -> int | None:
    """Steps after which a wrapper ends the episode; `gymnasium.make` tells the number to the wrapper alone.

    The wrapper is one of those who called: it resets through this environment.
    """
    limits, frame = [], inspect.currentframe()
    while frame is not None:
        caller = frame.f_locals.get("self")
        if isinstance(caller, TimeLimit) and caller.unwrapped is env:
            limits.append(caller._max_episode_steps)
        frame = frame.f_back
    return min(limits, default=None)


def _plain(info: dict[str, Tensor]) -> dict[str, Any]:
    """A row's numbers without their dimension."""
    return {name: value[0].item() for name, value in info.items()}
