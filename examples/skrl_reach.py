"""Learns apcc/Reach-v0 with skrl's PPO on the native batch: `python examples/skrl_reach.py`, about two minutes.

Needs `pip install skrl`. The policy is judged as that of ppo_reach.py; the learning curve goes to runs/skrl_reach.png.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch
from reaching import EPISODE, Curve, Scaled, conclude, judged, made, options, tell
from skrl.agents.torch.base import ExperimentCfg
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from skrl.utils import set_seed
from torch import Tensor, nn

GAMMA, LAMBDA, CLIP = 0.96, 0.95, 0.2
EPOCHS, MINIBATCHES, LEARNING_RATE = 6, 8, 1e-3
PARTS = 10
"""Of the training, after each of which the policy is judged."""


class Policy(GaussianMixin, Model):
    """A Gaussian over actions, whose spread does not depend on the observation."""

    def __init__(self, bound: Tensor, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.mean = Scaled(bound, self.num_actions)
        self.spread = nn.Parameter(torch.full((self.num_actions,), -0.5))

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean and log of the spread."""
        mean = self.mean(inputs["observations"])
        return mean, {"log_std": self.spread.expand_as(mean)}


class Value(DeterministicMixin, Model):
    """What an observation is worth."""

    def __init__(self, bound: Tensor, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = Scaled(bound, 1)

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Tensor]]:
        """(N, 1)."""
        return self.net(inputs["observations"]), {}


def learn(given: argparse.Namespace) -> Curve:
    """Trains an agent; its scores on the way, each with the environment steps up to then."""
    set_seed(given.seed)
    batch = made(given, given.envs, autoreset_mode="SAME_STEP")
    bound = torch.as_tensor(batch.single_observation_space.high)
    envs = wrap_env(batch, wrapper="gymnasium", verbose=False)
    spaces = {"observation_space": envs.observation_space, "action_space": envs.action_space, "device": envs.device}
    policy = Policy(bound, **spaces)
    agent = PPO(
        models={"policy": policy, "value": Value(bound, **spaces)},
        memory=RandomMemory(memory_size=EPISODE, num_envs=given.envs, device=envs.device),
        cfg=PPO_CFG(
            rollouts=EPISODE,
            learning_epochs=EPOCHS,
            mini_batches=MINIBATCHES,
            discount_factor=GAMMA,
            gae_lambda=LAMBDA,
            learning_rate=LEARNING_RATE,
            ratio_clip=CLIP,
            value_clip=0.0,
            value_loss_scale=0.5,
            time_limit_bootstrap=True,
            # Rewards on the scale of their mean, as in ppo_reach.py.
            rewards_shaper=lambda rewards, *_: (1.0 - GAMMA) * rewards,
            experiment=ExperimentCfg(write_interval=0, checkpoint_interval=0),
        ),
        **spaces,
    )
    parts = 4 if given.quick else PARTS
    rounds = max(1, given.steps // (given.envs * EPISODE * parts))
    training = SequentialTrainerCfg(
        timesteps=rounds * EPISODE, headless=True, disable_progressbar=True, close_environment_at_exit=False
    )
    trainer = SequentialTrainer(env=envs, agents=agent, cfg=training)
    curve = [(0, judged(given, policy.mean))]
    started = time.perf_counter()
    for part in range(1, parts + 1):
        trainer.train()
        curve.append((part * rounds * given.envs * EPISODE, judged(given, policy.mean)))
        tell(curve, started)
    return curve


def main() -> None:
    """Learns, compares and draws."""
    given = options(__doc__, "skrl_reach")
    conclude(given, learn(given), "skrl's PPO")


if __name__ == "__main__":
    main()
