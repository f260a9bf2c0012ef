"""Soft arms as Gymnasium environments; importing this package registers them.

import gymnasium
import apcc_torch.envs

envs = gymnasium.make_vec("apcc/Reach-v0", num_envs=4096)   # torch tensors, one batch
env = gymnasium.make("apcc/Reach-v0")                       # numpy arrays, one arm

reach, track, shape   what each task observes, does and rewards: start here
vector_env            the batch, with every argument; single_env: one row of it
simulator             one step as a pure function of state and action
tasks, actions        goals and errors; what an action means
kinematic, dynamic    the arms; adaptation: the controller in the loop; looking_ahead: for the next step
sensing               late and noisy readings
randomisation         what is drawn at a reset; streams: random numbers that belong to a row
places                material points of an arm; backbone_points: where they are on many arms, fast
row_trees             states as trees of rows
rendering             what a picture holds
registration          the ids
sb3                   the batch as a Stable-Baselines3 VecEnv; not imported here
"""

from __future__ import annotations

from apcc_torch.envs.outcome import TruncatedReason
from apcc_torch.envs.reach import ReachEnv, ReachEnvSettings, ReachVectorEnv
from apcc_torch.envs.registration import register_environments
from apcc_torch.envs.shape import ShapeEnv, ShapeEnvSettings, ShapeVectorEnv
from apcc_torch.envs.track import TrackEnv, TrackEnvSettings, TrackVectorEnv

__all__ = [
    "ReachEnv",
    "ReachEnvSettings",
    "ReachVectorEnv",
    "ShapeEnv",
    "ShapeEnvSettings",
    "ShapeVectorEnv",
    "TrackEnv",
    "TrackEnvSettings",
    "TrackVectorEnv",
    "TruncatedReason",
]

register_environments()
