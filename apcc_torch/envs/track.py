"""apcc/Track-v0: the tip after a moving point."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.envs.simulator import SimulatorSettings
from apcc_torch.envs.single_env import ArmEnv
from apcc_torch.envs.tasks import Track, TrackSettings
from apcc_torch.envs.vector_env import ArmVectorEnv


@dataclass(frozen=True, kw_only=True)
class TrackEnvSettings(SimulatorSettings, TrackSettings):
    """Settings of `TrackEnv` and `TrackVectorEnv`."""


class TrackVectorEnv(ArmVectorEnv):
    """Many arms; `TrackEnv` is the specification, `ArmVectorEnv` lists the arguments.

    Example:
        >>> envs = gymnasium.make_vec("apcc/Track-v0", num_envs=64, arm=Arm(lengths=[0.2, 0.25]))
        >>> observation, info = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 6))
        >>> observation.shape, reward.shape
        (torch.Size([64, 33]), torch.Size([64]))
    """

    task = Track
    settings_type = TrackEnvSettings


class TrackEnv(ArmEnv):
    """The tip of a soft arm follows a moving point. The arm, its dynamics and its actions are those of `ReachEnv`.

    ## Action space

    As `ReachEnv`: 9 numbers, 3 with `task_velocity` and `adaptation`.

    ## Observation space

    `Box(float32)`, 45 numbers; 51 with `action="adaptation"`. Values are clipped to their bounds.

    | Num | Observation | Unit | Min | Max |
    |---|---|---|---|---|
    | 0 … 35 | sensors, their velocities, tendons: as `ReachEnv` | m, m/s, m | -1, -5, -0.5 | 1, 5, 0.5 |
    | 36 … 38 | x, y, z of the target now | m | -1 | 1 |
    | 39 … 41 | from the last sensor, as read, to the target | m | -2 | 2 |
    | 42 … 44 | velocity of the target | m/s | -5 | 5 |
    | 45 … 47 | `adaptation` only: estimated rest lengths | m | -1 | 1 |
    | 48 … 50 | `adaptation` only: distances of the model's sensors from the read ones | m | -2 | 2 |

    ## Reward

    As `ReachEnv`, with e the distance from where the target is after the step.

    ## Starting state

    As `ReachEnv`. The target moves on r(t) = r_0 + A sin(omega t + phi), Eq. (51) [Dalenberg] with a phase an axis: r_0
    as `ReachEnv` draws its target, A uniform in 0.02 … 0.08 m (a third of that along z), omega in 0.5 … 2 rad/s, phi in
    0 … 2 pi.

    ## Termination and truncation

    As `ReachEnv`, after 400 steps.

    ## Version history

    * v0: first version.

    Example:
        >>> env = gymnasium.make("apcc/Track-v0", dynamics="dynamic", payload=(0.2, 0.2))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, info["is_success"]
        ((45,), False)
    """

    vector = TrackVectorEnv
