"""The batch as a Stable-Baselines3 `VecEnv`; needs stable-baselines3, which the extra `rl` brings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from apcc_torch.envs.vector_env import ArmVectorEnv
from apcc_torch.errors import ConfigError


class ArmVecEnv(VecEnv):
    """An `ArmVectorEnv` as Stable-Baselines3 steps environments: numpy, an `info` a row, reset in the same step.

    Args:
        envs: From `gymnasium.make_vec("apcc/Reach-v0", num_envs=..., autoreset_mode="SAME_STEP")`.

    Raises:
        ConfigError: `envs` is another environment, or has another autoreset mode.
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        batch = envs.unwrapped
        if not isinstance(batch, ArmVectorEnv):
            raise ConfigError(f"envs must be an ArmVectorEnv, got {type(batch).__name__}")
        if batch.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ConfigError(f'envs must be made with autoreset_mode="SAME_STEP", got {batch.autoreset_mode.name}')
        self.batch = batch
        self.actions: NDArray[Any] | None = None
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)

    def reset(self) -> VecEnvObs:
        """Starts all rows anew, with the seed that `seed` was given last."""
        observation, _ = self.batch.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observation.cpu().numpy()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keeps the actions for `step_wait`."""
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One step; a row that is done brings its last observation in its info."""
        if self.actions is None:
            raise ConfigError("step_async must be called before step_wait")
        observation, reward, terminated, truncated, info = self.batch.step(self.actions)
        self.actions = None
        done = (terminated | truncated).cpu().numpy()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            last = {name: value.cpu().numpy() for name, value in info["final_info"].items()}
            final, cut = info["final_obs"].cpu().numpy(), (truncated & ~terminated).cpu().numpy()
            for i in np.flatnonzero(done):
                infos[i] = {"terminal_observation": final[i], "TimeLimit.truncated": bool(cut[i])}
                infos[i] |= {name: last[name][i].item() for name in ("error", "is_success", "truncated_reason")}
        return observation.cpu().numpy(), reward.cpu().numpy(), done, infos

    def close(self) -> None:
        """Closes the batch."""
        self.batch.close()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Pictures of the first rows."""
        return self.batch.render() or ()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, once a row."""
        return [getattr(self.batch, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raises ConfigError: rows have no attributes of their own."""
        raise ConfigError(f"{attr_name} cannot be set: the rows of a batch have no attributes of their own")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raises ConfigError: rows have no methods of their own."""
        raise ConfigError(f"{method_name} cannot be called: the rows of a batch have no methods of their own")

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """False for every row."""
        return [False for _ in self._get_indices(indices)]
