"""Pictures of environments."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.report.style import SENSOR, TARGET, faded
from arm_rows import IDS, make

ARM = Arm.load("arm_1")


def has(frame: np.ndarray, color: str) -> bool:
    return bool((np.abs(frame.astype(int) - np.array(faded(color, 1.0)) * 255) < 12).all(-1).sum() > 20)


@pytest.mark.parametrize("name", IDS)
def test_pictures_hold_arm_sensors_and_goal(name: str) -> None:
    envs = make(name, 6, render_mode="rgb_array", render_rows=2, dynamics="dynamic")
    envs.reset(seed=0)
    frames = envs.render()
    assert frames is not None and len(frames) == 2
    for frame in frames:
        assert frame.shape == (500, 500, 3) and frame.dtype == np.uint8 and has(frame, SENSOR) and has(frame, TARGET)
    for _ in range(30):
        envs.step(torch.ones(6, 9))
    later = envs.render()
    assert later is not None and (later[0] != frames[0]).any()
    envs.close()


def test_tendons_run_beside_the_backbone_up_to_their_racks() -> None:
    envs = make("apcc/Reach-v0", 2, render_mode="rgb_array")
    envs.reset(seed=0)
    for _ in range(20):
        envs.step(torch.ones(2, 9))
    picture = envs.picture(1)
    away = (picture.tendons - picture.backbone).norm(dim=-1)
    ends = ARM.rest_lengths().cumsum(0).repeat_interleave(3)
    for tendon, end in zip(away, ends, strict=True):
        there = tendon[torch.isfinite(tendon)]
        torch.testing.assert_close(there, torch.full_like(there, ARM.tendon_offset))
        assert len(there) == pytest.approx(float(end) / 0.6 * 61, abs=1)
    view = envs.simulator.view(envs.state)  # type: ignore[arg-type]
    torch.testing.assert_close(picture.sensors.flatten().float(), view.observation[1, :9])


def test_every_render_mode_passes_gymnasiums_checker() -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    check_env(gymnasium.make("apcc/Reach-v0").unwrapped)


def test_what_cannot_be_drawn_is_said() -> None:
    envs = make(render_mode="rgb_array", renderers=None)
    envs.reset(seed=0)
    with pytest.raises(ConfigError, match="render_mode='rgb_array' needs one of renderers"):
        envs.render()
