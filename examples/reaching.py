"""What the examples that learn apcc/Reach-v0 share: the task, how a policy is judged, the picture of its learning."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import torch
from torch import Tensor, nn

import apcc_torch.envs
from apcc_torch.report import style

gymnasium.register_envs(apcc_torch.envs)

RATE, EPISODE = 20, 60
"""The policy acts 20 times a second, over 3 s: the arm answers slowly, and noise at 100 Hz would not move it."""
LATE = 10
"""Steps at the end of an episode over which the error that remains is averaged."""


class Scaled(nn.Module):
    """A network of two hidden layers on observations over their bounds, which differ by orders of magnitude."""

    def __init__(self, bound: Tensor, size: int) -> None:
        super().__init__()
        self.register_buffer("scale", 3.0 / bound)
        hidden = (nn.Linear(len(bound), 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
        self.net = nn.Sequential(*hidden, nn.Linear(64, size))
        nn.init.normal_(self.net[-1].weight, std=0.01)

    def forward(self, observation: Tensor) -> Tensor:
        """(..., size)."""
        return self.net(self.scale * observation)


class Score(NamedTuple):
    """Means over episodes: the return, the error over the last `LATE` steps in mm, and the share of those in 10 mm."""

    episode: float
    error_mm: float
    success: float

    def __str__(self) -> str:
        """A line of the table."""
        return f"return {self.episode:8.1f}   error {self.error_mm:6.1f} mm   within 10 mm {self.success:6.1%}"


Curve = list[tuple[int, Score]]
"""Environment steps up to a moment, and how the policy did then."""


def options(description: str | None, name: str, **defaults: Any) -> argparse.Namespace:
    """The command line of an example; `name` is its own, and that of its picture in runs/."""
    own = {"dynamics": "kinematic", "steps": 600_000, "envs": 256} | defaults
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dynamics", default=own["dynamics"], help="dynamic or kinematic (default: %(default)s)")
    parser.add_argument("--action", default="configuration_velocity", help="action mode (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=own["steps"], help="environment steps (default: %(default)s)")
    parser.add_argument("--envs", type=int, default=own["envs"], help="arms side by side (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="torch threads (default: %(default)s)")
    parser.add_argument("--figure", default=f"runs/{name}.png", help="where the curve goes (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a few arms and steps, to see it run; no figure")
    given = parser.parse_args()
    if given.quick:
        given.envs, given.steps = 32, 4 * 32 * EPISODE
    torch.set_num_threads(given.threads)
    torch.manual_seed(given.seed)
    return given


def task(given: argparse.Namespace) -> dict[str, Any]:
    """The environment's settings; with `dynamics="dynamic"` the payload is random, and not observed."""
    settings = {"dynamics": given.dynamics, "action": given.action, "dtype": "float32", "control_rate": RATE}
    return settings | {"plant": {"substeps": 100 // RATE}, "max_episode_steps": EPISODE}


def made(given: argparse.Namespace, rows: int, **others: Any) -> gymnasium.vector.VectorEnv:
    """The task as a batch of `rows` arms."""
    return gymnasium.make_vec("apcc/Reach-v0", num_envs=rows, **task(given), **others)


@torch.no_grad()
def judged(given: argparse.Namespace, act: Callable[[Tensor], Tensor]) -> Score:
    """One episode of rows that training never saw."""
    rows = 32 if given.quick else 512
    envs = made(given, rows)
    observation, _ = envs.reset(seed=1_000_003)
    total, error, success = torch.zeros(rows), [], []
    for _ in range(EPISODE - 1):
        observation, reward, _, _, info = envs.step(act(observation))
        total += reward
        error.append(info["error"])
        success.append(info["is_success"].float())
    late = [1e3 * float(torch.stack(error[-LATE:]).mean()), float(torch.stack(success[-LATE:]).mean())]
    return Score(float(total.mean()), *late)


def baselines(given: argparse.Namespace) -> dict[str, Score]:
    """What doing nothing and random actions come to."""
    size = made(given, 1).single_action_space.shape[0]
    chance = torch.Generator().manual_seed(given.seed)
    return {
        "no action": judged(given, lambda seen: torch.zeros(len(seen), size)),
        "random actions": judged(given, lambda seen: 2.0 * torch.rand(len(seen), size, generator=chance) - 1.0),
    }


def tell(curve: Curve, started: float) -> None:
    """Prints the last score on the way; `started` is of `time.perf_counter`."""
    steps, score = curve[-1]
    print(f"{steps:>9} steps {time.perf_counter() - started:5.0f} s   {score}", flush=True)


def conclude(given: argparse.Namespace, curve: Curve, name: str) -> None:
    """Prints the policy's score beside the baselines', and draws the curve."""
    others = baselines(given)
    for who, score in [*others.items(), (name, curve[-1][1])]:
        print(f"{who:<24}{score}")
    if not given.quick:
        print(draw(curve, others, name, Path(given.figure)))


def draw(curve: Sequence[tuple[int, Score]], others: dict[str, Score], name: str, path: Path) -> Path:
    """The learning curve beside the baselines."""
    figure = style.new_figure(9.0, 4.2)
    axes = figure.subplots(1, 2)
    steps = [1e-6 * step for step, _ in curve]
    labels = {"episode": "return of an episode", "error_mm": "error at the end (mm)"}
    for ax, (field, label) in zip(axes, labels.items(), strict=True):
        style.dress(ax, "environment steps (millions)", label)
        ax.plot(steps, [getattr(score, field) for _, score in curve], color=style.BLUE, linewidth=2.4, label=name)
        for (who, score), color, dash in zip(
            others.items(), (style.VERMILION, style.MUTED), style.DASHES[1:], strict=False
        ):
            ax.axhline(getattr(score, field), color=color, linestyle=dash, linewidth=1.8, label=who)
        ax.set_xlim(0.0, steps[-1])
    style.from_zero(axes[1])
    style.legend(axes[1], loc="center right")
    return style.save_figure(figure, path, dpi=110)
