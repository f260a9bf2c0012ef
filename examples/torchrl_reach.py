"""Learns apcc/Reach-v0 with TorchRL's PPO on the native batch: `python examples/torchrl_reach.py`, about two minutes.

Needs `pip install torchrl`. The environment is wrapped as it is: no copies between processes, no conversion to numpy.
The policy is judged as that of ppo_reach.py, and the learning curve goes to runs/torchrl_reach.png.
"""

from __future__ import annotations

import argparse
import time

import torch
from reaching import EPISODE, Curve, Scaled, conclude, judged, made, options, tell
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from tensordict.nn.probabilistic import InteractionType
from torch import Tensor, nn
from torchrl.envs import GymWrapper
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

GAMMA, LAMBDA, CLIP = 0.96, 0.95, 0.2
EPOCHS, MINIBATCHES, LEARNING_RATE = 6, 8, 1e-3


class Gaussian(nn.Module):
    """Mean and spread of actions; the spread does not depend on the observation."""

    def __init__(self, bound: Tensor, size: int) -> None:
        super().__init__()
        self.mean = Scaled(bound, size)
        self.spread = nn.Parameter(torch.full((size,), -0.5))
        self.split = NormalParamExtractor(scale_mapping="exp")

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Both, (..., size)."""
        mean = self.mean(observation)
        return self.split(torch.cat((mean, self.spread.expand_as(mean)), dim=-1))


def learn(given: argparse.Namespace) -> Curve:
    """Trains an actor and a critic; scores on the way, each with the environment steps up to then."""
    batch = made(given, given.envs, autoreset_mode="SAME_STEP")
    bound, size = torch.as_tensor(batch.single_observation_space.high), batch.single_action_space.shape[0]
    envs = GymWrapper(batch, device="cpu")
    envs.set_seed(given.seed)
    network = Gaussian(bound, size)
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=True,
    )
    critic = ValueOperator(Scaled(bound, 1), in_keys=["observation"])
    advantage = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=CLIP, entropy_coeff=0.0, critic_coeff=0.5, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE, eps=1e-5)
    rounds = max(1, given.steps // (given.envs * EPISODE))
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, rounds)
    curve = [(0, judged(given, network.mean))]
    started = time.perf_counter()
    for update in range(1, rounds + 1):
        with torch.no_grad():
            # Rewards on the scale of their mean, as in ppo_reach.py.
            rollout = envs.rollout(EPISODE, actor, break_when_any_done=False)
            rollout["next", "reward"] *= 1.0 - GAMMA
            advantage(rollout)
        flat = rollout.reshape(-1)
        for _ in range(EPOCHS):
            for index in torch.randperm(len(flat)).chunk(MINIBATCHES):
                losses = loss(flat[index])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        schedule.step()
        if update % max(1, rounds // 10) == 0 or update == rounds:
            curve.append((update * given.envs * EPISODE, judged(given, network.mean)))
            tell(curve, started)
    return curve


def main() -> None:
    """Learns, compares and draws."""
    given = options(__doc__, "torchrl_reach")
    conclude(given, learn(given), "TorchRL's PPO")


if __name__ == "__main__":
    main()
