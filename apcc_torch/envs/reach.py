"""apcc/Reach-v0: the tip to a point, with an unknown payload."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.envs.simulator import SimulatorSettings
from apcc_torch.envs.single_env import ArmEnv
from apcc_torch.envs.tasks import Reach, ReachSettings
from apcc_torch.envs.vector_env import ArmVectorEnv


@dataclass(frozen=True, kw_only=True)
class ReachEnvSettings(SimulatorSettings, ReachSettings):
    """Settings of `ReachEnv` and `ReachVectorEnv`."""


class ReachVectorEnv(ArmVectorEnv):
    """Many arms; `ReachEnv` is the specification, `ArmVectorEnv` lists the arguments.

    Example:
        >>> envs = gymnasium.make_vec("apcc/Reach-v0", num_envs=64, arm=Arm(lengths=[0.2, 0.25]))
        >>> observation, info = envs.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 6))
        >>> observation.shape, reward.shape
        (torch.Size([64, 30]), torch.Size([64]))
    """

    task = Reach
    settings_type = ReachEnvSettings


class ReachEnv(ArmEnv):
    """The tip of a soft arm reaches for a point, carrying a payload that it is not told of.

    ## Description

    The arm hangs from its base at the origin, 0.6 m long, with nine tendons in three racks and a position sensor at the
    end of each of the model's three sections. A configuration is (dx, dy, dL) a section: bends in rad, elongation in m.
    The world's z axis points up, so the arm lies at z < 0. A step is 10 ms (`control_rate`).

    That is the paper's arm 1. For another `arm` the sizes below follow from its numbers of sections, tendons and
    sensors; where its last sensor is not at the tip, one more is. Bounds of observed positions, velocities and tendons
    are in proportion to its length, and elongations stay within shares of its shortest section.

    With `dynamics="kinematic"` the arm follows its desired configuration q_d exactly, and the payload plays no part;
    with `"dynamic"` it is the plant of section V-B [Dalenberg]: six sections with mass, damping and tendon friction,
    tendon lengths held at B^T q_d by a PID loop, and the payload at the tip. An arm with chambers has no such loop: its
    valves are told the pressures that hold the nominal arm at q_d, without payload.

    ## Action space

    `Box(-1, 1, (a,), float32)`; values outside are clipped. What 1 is worth depends on `action`:

    | `action` | Num | Meaning | 1 is |
    |---|---|---|---|
    | `configuration_velocity` | 0 … 8 | rates of q_d: dx, dy, dL of each section | 3 rad/s, 3 rad/s, 0.1 m/s |
    | `task_velocity` | 0 … 2 | velocity of the tip, Eq. (16) with the nominal model at q_d | 0.5 m/s |
    | `tendon_lengths` | 0 … 8 | wanted change of each tendon's length; q_d moves there at the rates above | 0.05 m |
    | `pressures` | a chamber each | dynamic arms with chambers: the pressure, -1 the least, 1 the most | |
    | `adaptation` | 0 … 2 | the A-PCC controller drives the arm; Gamma is (9, 4.25, 3.5) 10^a | ten times |

    The first is the default. In every mode q_d stays within 3 rad and 0.08 m. With `adaptation` the target is the
    controller's too, and on a dynamic arm it looks ahead with `control={"lookahead": LookaheadSettings()}`.

    ## Observation space

    `Box(float32)`, 42 numbers; 48 with `action="adaptation"`. Values are clipped to their bounds.

    | Num | Observation | Unit | Min | Max |
    |---|---|---|---|---|
    | 0 … 8 | x, y, z of the sensors, from base to tip, as read: noisy and late | m | -1 | 1 |
    | 9 … 17 | their change since the last step, a second | m/s | -5 | 5 |
    | 18 … 26 | change of each tendon's length | m | -0.5 | 0.5 |
    | 27 … 35 | what it should be, B^T q_d | m | -0.5 | 0.5 |
    | 18 … 35 | chambers of a dynamic arm: each one's pressure, then as told, over the greatest | | -1 | 1 |
    | 36 … 38 | x, y, z of the target | m | -1 | 1 |
    | 39 … 41 | from the last sensor, as read, to the target | m | -2 | 2 |
    | 42 … 44 | `adaptation` only: estimated rest lengths | m | -1 | 1 |
    | 45 … 47 | `adaptation` only: distances of the model's sensors from the read ones | m | -2 | 2 |

    ## Reward

    r = [e < 0.01 m] - e / (0.1 m) - 0.01 mean(a^2), with e the true distance of the tip from the target. With
    `action="adaptation"` the last term is m / (0.05 m) instead, with m the mean distance of the virtual model from the
    true arm at the middles and ends of the sections.

    ## Starting state

    The arm hangs at rest under its own weight and the payload, q_d = 0. The target is the tip of a configuration of the
    row's own arm, bends uniform in ±0.5 rad and elongations in ±0.02 m. Drawn too: the payload, uniform in 0 … 0.5 kg,
    and what other ranges (`lengths`, `stiffness`, `noise`, `delay`, `estimate`) allow.

    ## Termination and truncation

    An episode never terminates. It is truncated after 300 steps, and where an action is not a number or the dynamic
    arm leaves its bounds; `info["truncated_reason"]` is then a `TruncatedReason` other than 0. In `make` the time limit
    is Gymnasium's wrapper, which gives no reason.

    `info`: `error` e in m, `is_success` e < 0.01 m, `truncated_reason`.

    ## Arguments

    Those of `ArmVectorEnv`, for `gymnasium.make` as for `gymnasium.make_vec`, which also takes `num_envs` and
    `autoreset_mode`.

    ## Version history

    * v0: first version.

    Example:
        >>> env = gymnasium.make("apcc/Reach-v0", dynamics="dynamic", payload=(0.2, 0.2))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, info["is_success"]
        ((42,), False)
    """

    vector = ReachVectorEnv
