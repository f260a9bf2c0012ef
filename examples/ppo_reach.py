"""Learns apcc/Reach-v0 with PPO on the native batch: `python examples/ppo_reach.py`, a few minutes on two cores.

The arm is the dynamic one, the payload random and not observed. Everything stays in torch: 512 arms step as one batch,
and the learner is about a hundred lines. At the end the policy is compared with doing nothing and with random actions,
on episodes that it never saw, and the learning curve is written to runs/ppo_reach.png.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import gymnasium
import torch
from reaching import EPISODE, Curve, conclude, judged, made, options, tell
from torch import Tensor, nn

GAMMA, LAMBDA, CLIP, ENTROPY, VALUE = 0.96, 0.95, 0.2, 0.0, 0.5
EPOCHS, MINIBATCHES, LEARNING_RATE = 6, 8, 1e-3


class Agent(nn.Module):
    """A Gaussian policy and a value, on observations scaled by their running mean and spread."""

    mean: Tensor
    square: Tensor
    count: Tensor

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.policy = nn.Sequential(
            nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, actions)
        )
        self.value = nn.Sequential(
            nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
        )
        nn.init.normal_(self.policy[-1].weight, std=0.01)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))
        self.register_buffer("mean", torch.zeros(observations))
        self.register_buffer("square", torch.ones(observations))
        self.register_buffer("count", torch.tensor(1e-4))

    def observe(self, observation: Tensor) -> None:
        """Takes a batch (N, o) into the running mean and mean square."""
        self.count += len(observation)
        share = len(observation) / self.count
        self.mean.lerp_(observation.mean(0), share)
        self.square.lerp_(observation.square().mean(0), share)

    def scaled(self, observation: Tensor) -> Tensor:
        """Observations of about unit spread."""
        spread = (self.square - self.mean.square()).clamp(min=1e-6).sqrt()
        return ((observation - self.mean) / spread).clamp(-10.0, 10.0)

    def distribution(self, observation: Tensor) -> torch.distributions.Normal:
        """What actions are drawn from."""
        return torch.distributions.Normal(self.policy(self.scaled(observation)), self.log_std.exp())

    def worth(self, observation: Tensor) -> Tensor:
        """Value (...) of observations."""
        return self.value(self.scaled(observation)).squeeze(-1)


class Rollout(NamedTuple):
    """T steps of N rows, time first."""

    observation: Tensor
    action: Tensor
    log_probability: Tensor
    advantage: Tensor
    value: Tensor


def collect(envs: gymnasium.vector.VectorEnv, agent: Agent, observation: Tensor, steps: int) -> tuple[Rollout, Tensor]:
    """Steps the batch, and estimates advantages; autoreset is in the same step."""
    rows: list[tuple[Tensor, ...]] = []
    with torch.no_grad():
        for _ in range(steps):
            agent.observe(observation)
            policy = agent.distribution(observation)
            action = policy.sample()
            later, reward, terminated, truncated, info = envs.step(action)
            done = terminated | truncated
            following = torch.where(done.unsqueeze(-1), info["final_obs"], later) if "final_obs" in info else later
            # A row that ran out of time is not at its end: what it would still have got counts.
            onward = agent.worth(following) * ~terminated
            rows.append(
                # Rewards on the scale of their mean: values are then of the order of one reward, not of an episode.
                (
                    observation,
                    action,
                    policy.log_prob(action).sum(-1),
                    agent.worth(observation),
                    (1.0 - GAMMA) * reward,
                    onward,
                    done,
                )
            )
            observation = later
        seen, action, log_probability, value, reward, onward, done = (
            torch.stack(column) for column in zip(*rows, strict=True)
        )
        advantage, after = torch.zeros_like(value), torch.zeros_like(value[0])
        for t in reversed(range(steps)):
            delta = reward[t] + GAMMA * onward[t] - value[t]
            after = delta + GAMMA * LAMBDA * after * ~done[t]
            advantage[t] = after
    return Rollout(seen, action, log_probability, advantage, value), observation


def improve(agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout) -> None:
    """Some epochs of the clipped objective over shuffled minibatches."""
    flat = Rollout(*(column.flatten(0, 1) for column in rollout))
    returns = flat.advantage + flat.value
    for _ in range(EPOCHS):
        for index in torch.randperm(len(returns)).chunk(MINIBATCHES):
            policy = agent.distribution(flat.observation[index])
            ratio = (policy.log_prob(flat.action[index]).sum(-1) - flat.log_probability[index]).exp()
            gain = flat.advantage[index]
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            surrogate = torch.minimum(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain).mean()
            miss = (agent.worth(flat.observation[index]) - returns[index]).square().mean()
            loss = VALUE * miss - surrogate - ENTROPY * policy.entropy().sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def learn(given: argparse.Namespace) -> Curve:
    """Trains an agent; its scores on the way, each with the environment steps up to then."""
    envs = made(given, given.envs, autoreset_mode="SAME_STEP")
    observation, _ = envs.reset(seed=given.seed)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    rounds = max(1, given.steps // (given.envs * EPISODE))
    every = max(1, rounds // 12)

    def learnt(seen: Tensor) -> Tensor:
        return agent.policy(agent.scaled(seen))

    curve = [(0, judged(given, learnt))]
    started = time.perf_counter()
    for update in range(1, rounds + 1):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - (update - 1) / rounds)
        # Whole episodes: the rows run in step, and part of an episode would be seen without the others.
        rollout, observation = collect(envs, agent, observation, EPISODE)
        improve(agent, optimizer, rollout)
        if update % every == 0 or update == rounds:
            curve.append((update * given.envs * EPISODE, judged(given, learnt)))
            tell(curve, started)
    return curve


def main() -> None:
    """Learns, compares and draws."""
    given = options(__doc__, "ppo_reach", dynamics="dynamic", steps=1_200_000, envs=512)
    conclude(given, learn(given), "PPO")


if __name__ == "__main__":
    main()
