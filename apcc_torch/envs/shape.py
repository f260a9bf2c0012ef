"""apcc/Shape-v0: the whole backbone onto another."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.envs.simulator import SimulatorSettings
from apcc_torch.envs.single_env import ArmEnv
from apcc_torch.envs.tasks import Shape, ShapeSettings
from apcc_torch.envs.vector_env import ArmVectorEnv


@dataclass(frozen=True, kw_only=True)
class ShapeEnvSettings(SimulatorSettings, ShapeSettings):
    """Settings of `ShapeEnv` and `ShapeVectorEnv`."""


class ShapeVectorEnv(ArmVectorEnv):
    """Many arms; `ShapeEnv` is the specification, `ArmVectorEnv` lists the arguments.

    Example:
        >>> envs = gymnasium.make_vec("apcc/Shape-v0", num_envs=64, arm=Arm(lengths=[0.2, 0.25]))
        >>> observation, info = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 6))
        >>> observation.shape, reward.shape
        (torch.Size([64, 42]), torch.Size([64]))
    """

    task = Shape
    settings_type = ShapeEnvSettings


class ShapeEnv(ArmEnv):
    """A soft arm takes the shape of a given backbone. The arm, its dynamics and its actions are those of `ReachEnv`.

    ## Action space

    As `ReachEnv`: 9 numbers, 3 with `task_velocity` and `adaptation`. The controller of `adaptation` is asked for the
    given backbone's tip.

    ## Observation space

    `Box(float32)`, 63 numbers; 69 with `action="adaptation"`. Values are clipped to their bounds.

    | Num | Observation | Unit | Min | Max |
    |---|---|---|---|---|
    | 0 … 35 | sensors, their velocities, tendons: as `ReachEnv` | m, m/s, m | -1, -5, -0.5 | 1, 5, 0.5 |
    | 36 … 53 | x, y, z of six points of the given backbone, the middle and end of each section | m | -1 | 1 |
    | 54 … 62 | from each sensor, as read, to its place on the given backbone | m | -2 | 2 |
    | 63 … 65 | `adaptation` only: estimated rest lengths | m | -1 | 1 |
    | 66 … 68 | `adaptation` only: distances of the model's sensors from the read ones | m | -2 | 2 |

    ## Reward

    r = [e < 0.01 m] - e / (0.05 m) - 0.01 mean(a^2), with e the shape error of Eq. (52) [Dalenberg] at those six
    points: the mean distance between the true arm's and the given backbone's. With `action="adaptation"` the last term
    is that of `ReachEnv`.

    ## Starting state

    As `ReachEnv`; the given backbone is that of the configuration whose tip is the target there.

    ## Termination and truncation

    As `ReachEnv`, after 300 steps.

    ## Version history

    * v0: first version.

    Example:
        >>> env = gymnasium.make("apcc/Shape-v0", dynamics="dynamic", payload=(0.2, 0.2))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, info["is_success"]
        ((63,), False)
    """

    vector = ShapeVectorEnv
