"""Environments whose controller looks ahead: a plan a row, that no other row's steps or resets touch."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, Measurement, compose
from apcc_torch.control.ahead import Ahead, AheadStatus
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.envs.adaptation import AdaptiveLoop
from apcc_torch.envs.stepping import ByMachineCode, ByTorch
from apcc_torch.envs.vector_env import ArmVectorEnv
from apcc_torch.errors import ConfigError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.chambers import Chambers
from arm_rows import IDS, actions, make, state_rows
from laws import bits, leaves

ARM = Arm(lengths=[0.2, 0.25], mass=0.4)
FEW = LookaheadSettings(samples=8, steps=3, batch=3)
DRAWN = {"lengths": (0.9, 1.1), "stiffness": (0.8, 1.2), "noise": (0.0, 1e-3), "delay": (0, 2)}
MODES = ("off", "aot")


def ahead(num_envs: int = 5, lookahead: Any = FEW, name: str = IDS[0], **given: Any) -> ArmVectorEnv:
    """Rows that look ahead."""
    control = {"lookahead": lookahead, **given.pop("control", {})}
    settings: dict[str, Any] = {"arm": ARM, "dynamics": "dynamic", "action": "adaptation", "plant": {"refine": 1}}
    return make(name, num_envs, control=control, **{**settings, **given})


def plans(envs: ArmVectorEnv) -> Ahead:
    state = envs.state
    assert state is not None and state.controller is not None and state.controller.ahead is not None
    return state.controller.ahead


def same(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(bits(a), bits(b)) for a, b in zip(one, other, strict=True))


def test_a_row_plans_what_its_controller_plans() -> None:
    """Step and look by hand, from what the row's sensors told."""
    envs = ahead(3, name=IDS[1], payload=(0.1, 0.3))
    envs.reset(seed=2)
    loop = envs.simulator.loop
    assert isinstance(loop, AdaptiveLoop)
    controller = loop.controller
    assert isinstance(controller, LookaheadController)
    for k in range(3):
        before = envs.state
        assert before is not None and before.controller is not None
        envs.step(torch.zeros(3, 2))
        seen = before.readings.seen.unflatten(-1, (-1, 3))
        T = torch.eye(4, dtype=seen.dtype).repeat(*seen.shape[:-1], 1, 1)
        T[..., :3, 3] = seen
        target = envs.simulator.task.target(before.goal, torch.full((3,), 0.01 * k, dtype=seen.dtype))
        stamp = torch.full((3,), 0.01 * (k + 1), dtype=seen.dtype)
        later, _ = controller(before.controller, Measurement(T, stamp), target)
        want = controller.look_ahead(later, target).ahead
        assert want is not None and int(want.number[0]) == k + 1
        for field, a, b in zip(Ahead._fields, plans(envs), want, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11, msg=field)


def test_the_nominal_racks_stay_what_they_are() -> None:
    """Each row's own are lent to the controller for a step, whoever else holds them."""
    envs = ahead(lengths=(0.9, 1.1))
    routing = envs.simulator.loop.controller.routing  # type: ignore[union-attr]
    assert routing is not None
    anchors = routing.anchors.clone()
    envs.reset(seed=0)
    envs.step(torch.zeros(5, 2))
    assert torch.equal(routing.anchors, anchors)


@pytest.mark.parametrize("mode", MODES)
def test_a_row_alone_is_the_row_in_a_batch(mode: str) -> None:
    few, many = (ahead(n, compile=mode, **DRAWN) for n in (2, 5))
    few.reset(seed=5), many.reset(seed=5)
    for k in range(6):
        action = actions(many, k)
        have, want = few.step(action[:2]), many.step(action)
        torch.testing.assert_close(have[0], want[0][:2], rtol=1e-5, atol=1e-6)
    for a, b in zip(plans(few), plans(many), strict=True):
        torch.testing.assert_close(a, b[:2], rtol=1e-6, atol=1e-8)
    assert (plans(few).next == AheadStatus.FOLLOWED).any()


def test_machine_code_plans_the_same() -> None:
    fast, plain = (
        ahead(compile=mode, autoreset_mode="SAME_STEP", max_episode_steps=4, **DRAWN) for mode in ("aot", "off")
    )
    assert isinstance(fast._stepping, ByMachineCode) and isinstance(plain._stepping, ByTorch)
    fast.reset(seed=3), plain.reset(seed=3)
    mask = torch.arange(5) == 2
    for k in range(7):
        action = actions(plain, k)
        have, want = fast.step(action), plain.step(action)
        torch.testing.assert_close(have[0], want[0], rtol=1e-5, atol=1e-6)
        assert torch.equal(have[3], want[3])
        if k == 1:
            fast.reset(options={"reset_mask": mask}), plain.reset(options={"reset_mask": mask})
        for a, b in zip(plans(fast), plans(plain), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("mode", MODES)
def test_a_reset_row_plans_afresh_and_no_other_plan_moves(mode: str) -> None:
    one, other = (ahead(compile=mode, **DRAWN) for _ in range(2))
    for envs in (one, other):
        envs.reset(seed=0)
        for k in range(4):
            envs.step(actions(envs, k))
    reset = torch.tensor([False, True, False, True, False])
    before = state_rows(one, ~reset)
    one.reset(options={"reset_mask": reset})
    assert same(before, state_rows(one, ~reset))
    fresh = plans(one)
    assert (fresh.number[reset] == 0).all() and (fresh.next[reset] == AheadStatus.NONE).all()
    assert (fresh.knots[reset] == 0.0).all() and (fresh.known[reset] == 0).all() and (fresh.y[reset] == 0.0).all()
    for k in range(3):
        one.step(actions(one, k)), other.step(actions(other, k))
    assert same(state_rows(one, ~reset), state_rows(other, ~reset))
    assert plans(one).number.tolist() == [7, 3, 7, 3, 7]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("autoreset", ["NEXT_STEP", "SAME_STEP"])
def test_rows_that_end_at_different_times(autoreset: str, mode: str) -> None:
    """A row's plan is as old as its episode; one that ended does not look, and one that begins has none."""
    envs = ahead(3, compile=mode, autoreset_mode=autoreset, max_episode_steps=4)
    envs.reset(seed=0)
    envs.step(actions(envs))
    envs.reset(options={"reset_mask": torch.tensor([False, True, False])})
    begun = False
    for k in range(9):
        truncated = envs.step(actions(envs, k))[3]
        assert envs.state is not None
        step, number = envs.state.step, plans(envs).number
        # With NEXT_STEP a row that ended stays for one more step, with the plans that it had.
        assert torch.equal(number, torch.where(truncated & (step > 0), step - 1, step))
        begun = begun or bool((step == 0).any() & (step > 0).any())
        assert torch.equal(plans(envs).next != AheadStatus.NONE, (step > 0) & ~truncated)
    assert begun


def test_a_row_that_goes_wrong_keeps_its_plan_and_disturbs_none() -> None:
    one, other = (ahead(autoreset_mode="DISABLED") for _ in range(2))
    for envs in (one, other):
        envs.reset(seed=0)
        envs.step(actions(envs))
    action, rows = actions(one, 1), torch.arange(5) != 3
    before = [leaf[3].clone() for leaf in plans(one)]
    other.step(action)
    action[3] = torch.nan
    truncated = one.step(action)[3]
    assert truncated.tolist() == [False, False, False, True, False]
    assert same(before, [leaf[3] for leaf in plans(one)])
    assert same(state_rows(one, rows), state_rows(other, rows))


@pytest.mark.parametrize("mode", MODES)
def test_a_state_is_kept_with_its_plans_and_a_seed_decides_them(mode: str) -> None:
    envs, again = (ahead(compile=mode, **DRAWN) for _ in range(2))
    for each in (envs, again):
        each.reset(seed=1)
        for k in range(3):
            each.step(actions(each, k))
    assert same(leaves(envs.state), leaves(again.state))
    kept = envs.state
    for k in range(3):
        envs.step(actions(envs, 5 + k))
    want = leaves(envs.state)
    for each in (envs, again):  # its own again, and another environment's
        each.state = kept
        for k in range(3):
            each.step(actions(each, 5 + k))
        assert same(leaves(each.state), want)


def test_one_arm_alone() -> None:
    env = gymnasium.make(
        IDS[0], arm=ARM, dynamics="dynamic", action="adaptation", control={"lookahead": FEW}, max_episode_steps=3
    )
    batch = ahead(1, plant={})
    observation, _ = env.reset(seed=4)
    want, _ = batch.reset(seed=4)
    for k in range(3):
        action = actions(batch, k)
        observation, _, _, truncated, _ = env.step(action[0].numpy())
        want = batch.step(action)[0]
        assert torch.equal(torch.from_numpy(observation), want[0])
    assert truncated


def test_a_loaded_arm_is_sooner_at_its_goal() -> None:
    """Within 10 mm of it to stay, on the same episodes, whatever the first estimates of its lengths were."""
    arm = {"arm": "arm_1", "payload": (0.5, 0.5), "plant": {"substeps": 4}, "control_rate": 25}
    after = []
    for lookahead in (None, LookaheadSettings(samples=24)):
        envs = ahead(3, lookahead, control={"adaptive": False}, **arm)
        envs.reset(seed=0)
        errors = torch.stack([envs.step(torch.zeros(3, 3))[4]["error"] for _ in range(100)])
        outside = (errors > 0.01).flip(0).int()
        after.append(len(errors) - torch.where(outside.any(0), outside.argmax(0), len(errors)))
    standard, looked = after
    assert (standard == 100).all() and (looked < 90).all(), after


def test_what_is_composed_looks_ahead() -> None:
    """All of a controller, or its look ahead alone; as the command line of a simulation says it."""
    words = ("experiment=dynamic_run_2", "lookahead=mppi", "lookahead.samples=8", "lookahead.steps=3")
    whole = compose(*words, "feedback=position", "adaptation=normalised").settings
    alone = compose(*words).settings.lookahead
    for control in (whole, {"lookahead": alone}):
        envs = make(IDS[0], 2, dynamics="dynamic", action="adaptation", control=control)
        envs.reset(seed=0)
        envs.step(torch.zeros(2, 3)), envs.step(torch.zeros(2, 3))
        assert (plans(envs).status != AheadStatus.NONE).all()
        assert envs.simulator.loop.controller.lookahead.samples == 8  # type: ignore[union-attr]
    inner = make(IDS[0], 2, dynamics="dynamic", action="adaptation", control=whole).simulator.loop
    assert inner is not None and (inner.controller.inverse_kinematics.K.diagonal() == whole.controller.K).all()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"dynamics": "kinematic"}, "where dynamics is kinematic: its rollouts are of an arm with forces"),
        ({"action": "task_velocity"}, "where action is not adaptation: no controller drives the arm"),
        (
            {"control": {"model": AffineBackbone.settings_type()}},
            "where model is not pcc: its rollouts are of sections",
        ),
        ({"arm": ARM.changed(chambers=Chambers())}, r"where arm\.chambers are given: its rollouts are of tendons"),
    ],
)
def test_what_cannot_look_ahead_says_so(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=f"lookahead must be none {told}"):
        ahead(**given)


def test_a_controller_of_poses_is_refused() -> None:
    for control in ({"mode": "pose"}, ControlSettings().with_keys({"adaptation": None})):
        with pytest.raises(ConfigError, match=r"feedback\.mode must be position|adaptation must be an AdaptiveLaw"):
            make(IDS[0], 2, action="adaptation", control=control)
