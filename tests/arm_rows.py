"""Environments for tests: rows with given parameters, and batches made as a user makes them."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from torch import Tensor

import apcc_torch.envs
from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.envs.vector_env import ArmVectorEnv
from laws import generator, leaves

gymnasium.register_envs(apcc_torch.envs)

IDS = ("apcc/Reach-v0", "apcc/Track-v0", "apcc/Shape-v0")


def row_parameters(n: int, dtype: torch.dtype = torch.float64, **given: Tensor) -> RowParameters:
    """Rows of nominal arms without payload, noise or delay, but for what is given."""
    one = torch.ones(n, dtype=dtype)
    three = torch.ones(n, 3, dtype=dtype)
    plain = RowParameters(three, one, 0 * one, 0 * one, torch.zeros(n, dtype=torch.int64), three)
    return plain._replace(**given)


def make(name: str = "apcc/Reach-v0", num_envs: int = 6, **settings: Any) -> ArmVectorEnv:
    """A batch."""
    envs = gymnasium.make_vec(name, num_envs=num_envs, **settings)
    assert isinstance(envs, ArmVectorEnv)
    return envs


def actions(envs: ArmVectorEnv, seed: int = 0) -> Tensor:
    """Random actions (N, a)."""
    draws = torch.rand(envs.num_envs, envs.simulator.action_size, generator=generator(seed))
    return 2.0 * draws - 1.0


def state_rows(envs: ArmVectorEnv, rows: Any) -> list[Tensor]:
    """Those rows of every tensor of the state."""
    return [leaf[rows] for leaf in leaves(envs.state)]
