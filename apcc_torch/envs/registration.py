"""The environments' ids in Gymnasium's registry."""

from __future__ import annotations

import gymnasium

RENDERERS = {
    "rgb_array": "apcc_torch.report.arm_scene:ArmScene",
    "human": "apcc_torch.viewing.env_window:EnvWindow",
}
"""What draws in each render mode; names, because environments do not import what has matplotlib or viser."""

EPISODES = {"Reach": 300, "Track": 400, "Shape": 300}
"""Longest episode of each task, steps."""


def environment_id(task: str) -> str:
    """The id of a task: "Reach" -> "apcc/Reach-v0"."""
    return f"apcc/{task}-v0"


def register_environments() -> None:
    """Registers every task; one that is registered already stays as it is."""
    for task, steps in EPISODES.items():
        if environment_id(task) in gymnasium.registry:
            continue
        module = f"apcc_torch.envs.{task.lower()}"
        gymnasium.register(
            environment_id(task),
            entry_point=f"{module}:{task}Env",
            vector_entry_point=f"{module}:{task}VectorEnv",
            max_episode_steps=steps,
            kwargs={"renderers": RENDERERS},
        )
