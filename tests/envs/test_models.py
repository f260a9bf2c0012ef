"""The adaptive controller in an environment, with kinematic models beside constant curvature."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.errors import ConfigError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from arm_rows import make


@pytest.mark.parametrize("model", [ConstantStrainBackbone, AffineBackbone])
def test_the_controller_drives_the_dynamic_arm(model: type[KinematicModel]) -> None:
    envs = make("apcc/Reach-v0", 2, dynamics="dynamic", action="adaptation", control={"model": model.settings_type()})
    envs.reset(seed=0)
    assert envs.state is not None and envs.state.q_d.shape == (2, model(3).n)
    goal = envs.state.goal
    errors = []
    for _ in range(60):
        observation, reward, _, _, info = envs.step(torch.zeros(2, 3))
        assert bool(torch.isfinite(observation).all()) and bool(torch.isfinite(reward).all())
        errors.append(info["error"])
    assert goal is not None and bool((errors[-1] < errors[0]).all())


def test_the_kinematic_arm_has_constant_curvature() -> None:
    with pytest.raises(ConfigError, match="model must be PCCBackbone where the arm is kinematic"):
        make("apcc/Reach-v0", 2, dynamics="kinematic", control={"model": AffineBackbone.settings_type()})
