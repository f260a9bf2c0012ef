"""Any arm in every environment: the paper's by default, and others by object, file or name."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from apcc_torch.envs import TruncatedReason
from apcc_torch.envs.dynamic import DynamicArm
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.backbone import PCCBackbone
from arm_rows import IDS, actions, make, row_parameters

LIKE = torch.empty(0, dtype=torch.float64)
MODES = ("configuration_velocity", "task_velocity", "tendon_lengths", "adaptation")
DRAWN = {"lengths": (0.9, 1.1), "stiffness": (0.8, 1.2), "noise": (0.0, 1e-3), "delay": (0, 2)}
TWO = Arm(lengths=[0.2, 0.25], mass=0.4)
FIVE = Arm(
    lengths=[0.1, 0.12, 0.15, 0.1, 0.03],
    sensors=[0.06, 0.1, 0.3, 0.44],
    true_sensors=[0.07, 0.1, 0.3, 0.43],
    racks=[0.2, 0.3, 0.5],
    tendons_per_rack=4,
    layout="independent",
    base="standing",
    mass=0.1,
    bending_stiffness=3.0,
    stiffness_rule="proportional",
)


def test_the_default_is_the_papers() -> None:
    arm = make().simulator.description
    assert arm == Arm.load("arm_1") == Arm(lengths=(0.105, 0.255, 0.240), name="arm_1")


def test_one_plant_step_a_period_is_enough() -> None:
    """One step of 10 ms stays within 0.1 mm of sixteen, at full rates and with the largest payload."""
    arm, ends = Arm.load("arm_1"), []
    B = arm.routing().matrix(arm.rest_lengths())
    for substeps in (1, 16):
        body = DynamicArm(arm, 0.01, False, LIKE, plant={"substeps": substeps})
        rows = row_parameters(3, payload=torch.tensor([0.0, 0.25, 0.5], dtype=torch.float64))
        state = body.initial(rows)
        y = torch.zeros(3, 9, dtype=torch.float64)
        rate = torch.tensor([3.0, -3.0, 0.1] * 3, dtype=torch.float64) @ B
        for k in range(60):
            y_next = y + 0.01 * rate * (1 if k < 30 else -1)
            state, y = body.step(state, y, y_next, y, rows), y_next
        ends.append(body.points(state, rows).backbone)
    assert float((ends[0] - ends[1]).norm(dim=-1).max()) < 1e-4


@pytest.mark.parametrize("action", MODES)
@pytest.mark.parametrize("dynamics", ["kinematic", "dynamic"])
@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("arm", [TWO, FIVE], ids=["two", "five"])
def test_other_arms(arm: Arm, name: str, dynamics: str, action: str) -> None:
    """Every size follows from the arm, and nothing that is observed is not finite or at its bound."""
    n_b, n_a, k = arm.n_sections, arm.n_tendons, {2: 2, 5: 5}[arm.n_sections]  # the five-section arm's tip has one more
    envs = make(name, 3, arm=arm, dynamics=dynamics, action=action, **DRAWN)
    task = {"Reach": 6, "Track": 9, "Shape": 6 * n_b + 3 * k}[name[5:10]]
    size = 6 * k + 2 * n_a + task + (n_b + k if action == "adaptation" else 0)
    observation, _ = envs.reset(seed=0)
    for step in range(20):
        assert observation.shape == (3, size) and observation.numpy() in envs.observation_space
        assert bool((observation.abs() < 0.99 * envs.simulator.bounds).all())
        observation, reward, _, truncated, info = envs.step(0.5 * actions(envs, step))
        assert bool(torch.isfinite(reward).all())
        # The law of a five-section arm can run away under random gains; then the row says so, and nothing else.
        told = info["truncated_reason"][truncated]
        assert not len(told) or (
            arm is FIVE and action == "adaptation" and bool((told == TruncatedReason.DIVERGED).all())
        )


@pytest.mark.parametrize("arm", [TWO, Arm(lengths=[0.12] * 5, sensors=[0.1, 0.2, 0.35, 0.5])], ids=["two", "five"])
def test_the_controller_brings_other_arms_to_their_targets(arm: Arm) -> None:
    envs = make("apcc/Reach-v0", 3, arm=arm, action="adaptation", max_episode_steps=None, control={"null_gain": 0.2})
    envs.reset(seed=0)
    # An estimate of five sections takes a detour along the exact sensitivity; errors fall to an eighth in 200 steps.
    for _ in range(500):
        _, _, _, _, info = envs.step(torch.zeros(3, arm.n_sections))
    assert float(info["error"].max()) < 0.015


@pytest.mark.parametrize("dynamics", ["kinematic", "dynamic"])
def test_sensors_stay_at_their_share_of_longer_sections(dynamics: str) -> None:
    arm = Arm(lengths=[0.2, 0.3], sensors=[0.15, 0.2, 0.35])
    envs = make("apcc/Reach-v0", 3, arm=arm, dynamics=dynamics, plant={"refine": 3}, lengths=(0.8, 1.2))
    envs.reset(seed=0)
    for step in range(10):
        observation, *_ = envs.step(actions(envs, step))
    assert envs.state is not None
    first, second = (arm.rest_lengths() * envs.state.rows.lengths).unbind(-1)
    X = torch.stack((0.75 * first, first, first + 0.5 * second, first + second), dim=-1)
    q, lengths = envs.simulator.arm.configuration(envs.state.arm), envs.simulator.arm.lengths(envs.state.rows)
    shares = torch.tensor([0.75, 1.0, 0.5, 1.0], dtype=torch.float64)
    section = torch.tensor([0, 0, 1, 1])
    parts = lengths.shape[-1] // 2
    T = PCCBackbone(lengths.shape[-1], arm.base_rotation()).pose(
        q, lengths, (shares * parts - ((shares * parts).ceil() - 1)).expand(3, 4),
        (section * parts + (shares * parts).ceil().long() - 1).expand(3, 4),
    )  # fmt: skip
    torch.testing.assert_close(observation[:, :12].double(), T[..., :3, 3].flatten(1), rtol=0.0, atol=1e-6)
    assert float((X[:, -1] - lengths.sum(-1)).abs().max()) < 1e-12


def test_a_leaning_arm_starts_at_rest() -> None:
    arm = Arm(lengths=[0.2, 0.25], mass=0.3, placement=Placement(gravity=(3.0, 0.0, -9.0)))
    body = DynamicArm(arm, 0.01, False, LIKE)
    payload, one = torch.tensor([0.0, 0.1], dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64)
    rows = row_parameters(2, payload=payload, lengths=one)
    start = body.initial(rows)
    later, y = start, torch.zeros(2, 6, dtype=torch.float64)
    for _ in range(20):
        later = body.step(later, y, y, y, rows)
    assert float(start.arm.q[:, :2].abs().amax(-1).min()) > 0.01
    torch.testing.assert_close(later.arm.q, start.arm.q, rtol=0.0, atol=1e-3)
    assert float(later.arm.qdot.abs().max()) < 1e-2


def test_what_differs_on_the_true_arm() -> None:
    stiff = make(arm=TWO, dynamics="dynamic", plant={"arm": {"axial_stiffness": 1000.0}})
    soft = make(arm=TWO, dynamics="dynamic")
    depths = [envs.reset(seed=0)[0][0, 5] for envs in (stiff, soft)]
    assert float(depths[1]) < float(depths[0]) < -0.45
    with pytest.raises(ConfigError, match=r"plant\.arm must have as many sections"):
        make(arm=TWO, dynamics="dynamic", plant={"arm": {"lengths": [0.2, 0.2, 0.2]}})


def test_a_file_and_a_name(tmp_path: Path) -> None:
    TWO.save(tmp_path / "two.yaml")
    for arm in (tmp_path / "two.yaml", str(tmp_path / "two.yaml")):
        assert make(arm=arm).simulator.description == TWO
    with pytest.raises(ConfigError, match=r"the package has no arm 'arm1'; did you mean arm_1\?"):
        make(arm="arm1")


def test_a_batch_of_arms_is_refused() -> None:
    lengths = torch.tensor([[0.1, 0.2], [0.2, 0.1]], dtype=torch.float64)
    for arm in (Arm(lengths=lengths), TWO.changed(mass=torch.tensor([0.4, 0.5], dtype=torch.float64))):
        with pytest.raises(ConfigError, match="arm must be one arm"):
            make(arm=arm)
