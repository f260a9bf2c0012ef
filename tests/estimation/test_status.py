"""What algorithm 2 says of its estimates, against an oracle that lays the arm out again and judges for itself."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.estimation.feedback import Feedback, FeedbackStatus
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback, ShapeFeedbackSettings
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie.rotations import rotation_angle
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.statics import equilibrium
from arms import HANGING_BASE, PI
from laws import bits, generator, leaves, normal, uniform

D = torch.float64
MODES = ("position", "pose", "hierarchical")
S = FeedbackStatus


def shapes(rows: int, lengths: Tensor, most: float, rng: torch.Generator) -> Tensor:
    """Configurations bent up to `most` rad a section, in any direction, and stretched by up to a tenth."""
    n_b = len(lengths)
    angle, size = uniform((rows, n_b), 0.0, 6.3, D, rng), uniform((rows, n_b), 0.0, most, D, rng)
    dL = lengths * uniform((rows, n_b), -0.1, 0.1, D, rng)
    return torch.stack((size * angle.cos(), size * angle.sin(), dL), dim=-1).flatten(-2)


def judge(f: StateFeedback, lengths: Tensor, T: Tensor, found: Feedback) -> None:
    """Checks lengths, errors and the rank of a result all of whose rows are valid."""
    now = lengths + found.q_bar[..., 2::3]
    assert float(now.min()) > 0.0
    at, J = f.backbone.pose_and_body_jacobian(found.q_bar, lengths, *decouple(f.abscissae, lengths))
    linear = (at - T)[..., :3, 3].norm(dim=-1)
    angular = rotation_angle(at[..., :3, :3], T[..., :3, :3])
    reach = lengths.sum()
    if f.mode == "position":
        angular, J = torch.zeros_like(angular), J[..., 3:, :]
    off = ((linear > 1.01 * f.linear_threshold) | (angular > 1.01 * f.angular_threshold)).any(-1)
    assert not (off & (found.status == S.CONVERGED)).any()
    assert not ((linear > reach).any(-1) & (found.status == S.SETTLED)).any()
    assert not ((angular > 2.1).any(-1) & (found.status == S.SETTLED)).any()
    strength = torch.linalg.svdvals(J.flatten(-3, -2))
    clear = ~((strength > 1e-5) & (strength < 1e-3)).any(-1)
    unseen = f.unseen(f.infer(found.q_bar, lengths, T)._replace(feedback=found))
    assert torch.equal(unseen[clear], J.shape[-1] - (strength > 1e-4).sum(-1)[clear])


@pytest.mark.parametrize("mode", MODES)
def test_two_thousand_shapes_are_found_from_the_straight_arm(mode: str) -> None:
    f = StateFeedback(PCCBackbone(3, HANGING_BASE), PI.cumsum(0), mode)
    q = shapes(2000, PI, 2.5, generator(0))
    T = f.backbone.pose(q, PI, *decouple(f.abscissae, PI))
    found = f(torch.zeros_like(q), PI, T)
    judge(f, PI, T, found)
    again = f(found.q_bar, PI, T)
    judge(f, PI, T, again)
    assert (again.status == S.CONVERGED).all()
    assert float((again.q_bar - q).abs().max()) < 0.05


def test_a_section_is_not_turned_inside_out() -> None:
    # From zero, the shortest way to the last sensor leads through nothing.
    f = StateFeedback(PCCBackbone(3), PI.cumsum(0))
    q = torch.tensor([0.0, 0.0, 0.0, 1.2, 1.2, 0.0, 1.2, 1.2, 0.0], dtype=D)
    found = f(torch.zeros_like(q), PI, f.backbone.pose(q, PI, *decouple(f.abscissae, PI)))
    assert found.status == S.CONVERGED
    torch.testing.assert_close(found.q_bar, q, rtol=0, atol=1e-3)
    # A seed that is inside out already is not kept.
    inside_out = q.clone()
    inside_out[8] = -0.9
    found = f(inside_out, PI, f.backbone.pose(q, PI, *decouple(f.abscissae, PI)))
    assert found.status == S.CONVERGED and float((PI + found.q_bar[2::3]).min()) > 0.0


@pytest.mark.parametrize("seed", range(12))
def test_random_sensors_against_the_oracle(seed: int) -> None:
    rng = generator(seed)
    n_b, k = 2 + seed % 3, 1 + seed % 4
    lengths = uniform((n_b,), 0.1, 0.3, D, rng)
    X = uniform((k,), 0.03, float(lengths.sum()), D, rng).sort().values
    f = StateFeedback(PCCBackbone(n_b), X, MODES[seed % 3 if seed % 2 else 1])
    q = shapes(60, lengths, 2.5, rng)
    T = f.backbone.pose(q, lengths, *decouple(X, lengths))
    T[30:, :, :3, 3] += 0.01 * normal((30, k, 3), D, rng)
    estimate = torch.zeros_like(q)
    for _ in range(3):
        found = f(estimate, lengths, T)
        judge(f, lengths, T, found)
        estimate = found.q_bar


ARMS = {
    "the paper's": {"lengths": [0.105, 0.255, 0.24]},
    "short": {"lengths": [0.03, 0.03], "tendon_offset": 0.004, "mass": 0.02, "bending_stiffness": 0.01},
    "too heavy for itself": {"lengths": [1.0, 1.0, 1.0], "tendon_offset": 0.05, "mass": 20.0},
    "four, standing": {"lengths": [0.1, 0.15, 0.1, 0.12], "base": "standing", "mass": 0.2, "bending_stiffness": 3.0},
    "five": {"lengths": [0.1, 0.14, 0.12, 0.14, 0.1]},
    "sensors between the ends": {"lengths": [0.2, 0.2, 0.2], "sensors": [0.13, 0.31, 0.47, 0.6]},
    "fewer sensors than sections": {"lengths": [0.105, 0.255, 0.24], "sensors": [0.36, 0.6]},
}


@pytest.mark.parametrize(("name", "mode"), [(name, MODES[(i + 1) % 3]) for i, name in enumerate(ARMS)])
def test_what_no_arm_is_shaped_like_is_not_said_to_be_found(name: str, mode: str) -> None:
    """Algorithm 2 and the shipped law's estimator on 2000 shapes, most of which mechanics does not allow."""
    arm = Arm(**ARMS[name])  # type: ignore[arg-type]
    lengths, backbone, X = arm.rest_lengths(), arm.backbone(), arm.sensor_places()
    rows = 2000 // len(ARMS)
    q = shapes(rows, lengths, 2.5, generator(4))
    T = backbone.pose(q, lengths, *decouple(X, lengths))
    f = StateFeedback(backbone, X, mode)
    found = f(torch.zeros_like(q), lengths, T)
    judge(f, lengths, T, found)
    judge(f, lengths, T, f(found.q_bar, lengths, T))
    followed = ShapeFeedback.on(arm, backbone, ShapeFeedbackSettings())
    q_bar, pi = torch.zeros_like(q), lengths.expand(rows, -1)
    state, dt = followed.initial_state(q_bar, pi), torch.full((rows,), 0.01, dtype=D)
    tendons = q @ arm.routing().matrix(lengths)
    for _ in range(30):
        last, before = state, q_bar
        state, inference = followed.infer(f, state, q_bar, pi, T, None, None, tendons, dt)
        q_bar = inference.feedback.q_bar
        judge_followed(followed, f, inference.feedback, (last, before), (state, q_bar), T, lengths)
    assert (inference.feedback.status != S.INVALID).all()


def test_a_loaded_arm_that_hangs_still_is_said_to_have_settled() -> None:
    arm = Arm(lengths=[0.105, 0.255, 0.24])
    payload = torch.tensor([0.0, 0.1, 1.0], dtype=D)
    rest = equilibrium(arm.dynamics(2), payload=payload)
    pieces, X = arm.refined(2), arm.sensor_places()
    T = PCCBackbone(6, arm.base_rotation()).pose(rest.q, pieces, *decouple(X, pieces))
    backbone, pi = arm.backbone(), arm.rest_lengths().expand(3, -1)
    f, followed = StateFeedback(backbone, X), ShapeFeedback.on(arm, backbone, ShapeFeedbackSettings())
    q_bar, dt = torch.zeros(3, 9, dtype=D), torch.full((3,), 0.02, dtype=D)
    state, tendons = followed.initial_state(q_bar, pi), rest.q @ arm.routing().matrix(pieces)
    said = []
    for _ in range(150):
        state, inference = followed.infer(f, state, q_bar, pi, T, None, None, tendons, dt)
        q_bar = inference.feedback.q_bar
        said.append(inference.feedback.status)
    # Under little weight the sensors are met at once; under more it is not said to rest before it does.
    assert (torch.stack(said[:4]) != S.SETTLED).all() and said[3][2] == S.ITERATION_LIMIT
    assert ((said[-1] == S.SETTLED) | (said[-1] == S.CONVERGED)).all(), said[-1]


def judge_followed(
    followed: ShapeFeedback,
    f: StateFeedback,
    found: Feedback,
    before: tuple[FollowedShape, Tensor],
    after: tuple[FollowedShape, Tensor],
    T: Tensor,
    lengths: Tensor,
) -> None:
    """Checks that lengths are some, that what settled is at rest, and that the arm's own shape meets the sensors."""
    (last, q_last), (state, q_bar) = before, after
    arm = followed.shape
    pieces = [arm.dynamics.lengths + arm.configuration(s.shape)[..., 2::3] for s in (last, state)]
    for now in (*pieces, lengths + q_bar[..., 2::3], lengths + arm.strain(state.shape)[..., 2::3]):
        assert float(now.min()) > 0.0
    within = (found.linear_error < f.linear_threshold) & (found.angular_error < f.angular_threshold)
    assert torch.equal(within.all(-1), found.status == S.CONVERGED)
    settled = found.status == S.SETTLED
    assert not ((q_bar - q_last).abs().amax(-1) > f.settled_step)[settled].any()
    q = arm.configuration(last.shape)
    at = arm.backbone.pose(q, arm.pieces(q), *arm.sensors_at(q))
    linear = (at - T)[..., :3, 3].norm(dim=-1) / arm.position_noise
    assert not (linear > 10.2).any(-1)[settled].any()
    if f.mode != "position":
        angular = rotation_angle(at[..., :3, :3], T[..., :3, :3]) / arm.angular_noise
        assert not (angular > 10.2).any(-1)[settled].any()


def not_poses(T: Tensor) -> dict[str, Tensor]:
    """A pose, spoilt."""
    spoilt: dict[str, Any] = {name: T.clone() for name in ("zeros", "doubled", "mirrored", "skewed", "row")}
    spoilt["zeros"][:] = 0.0
    spoilt["doubled"][..., :3, :3] *= 2.0
    spoilt["mirrored"][..., :3, 0] *= -1.0
    spoilt["skewed"][..., :3, 0] += 0.1
    spoilt["row"][..., 3, :] = torch.tensor([0.0, 0.0, 0.1, 1.0])
    return spoilt


@pytest.mark.parametrize("mode", MODES)
def test_what_is_no_pose_is_refused_row_by_row(mode: str) -> None:
    f = StateFeedback(PCCBackbone(3), PI.cumsum(0), mode)
    q = shapes(3, PI, 0.8, generator(1))
    seed = q + 0.05
    T = f.backbone.pose(q, PI, *decouple(f.abscissae, PI))
    want = f(seed, PI, T)
    for name, spoilt in not_poses(T[1, 1]).items():
        bad = T.clone()
        bad[1, 1] = spoilt
        found = f(seed, PI, bad)
        assert found.status.tolist() == [0, S.INVALID, 0], name
        assert torch.equal(found.q_bar[1], seed[1]) and int(f.unseen(f.infer(seed, PI, bad))[1]) == 9
        for have, was in zip(leaves(found), leaves(want), strict=True):
            assert torch.equal(bits(have[[0, 2]]), bits(was[[0, 2]])), name
        # Of a sensor that does not count nothing is asked; of one whose orientation does not, no rotation.
        left_out = torch.tensor([True, False, True])
        assert (f(seed, PI, bad, left_out).status == S.CONVERGED).all()
        if name in ("doubled", "mirrored", "skewed"):
            assert f(seed, PI, bad, None, left_out).status[1] != S.INVALID


def test_lengths_that_are_none_are_invalid() -> None:
    f = StateFeedback(PCCBackbone(3), PI.cumsum(0))
    q = shapes(3, PI, 0.5, generator(2))
    T = f.backbone.pose(q, PI, *decouple(f.abscissae, PI))
    lengths = PI.repeat(3, 1)
    lengths[0, 1], lengths[2, 2] = 0.0, -0.1
    found = f(q, lengths, T)
    assert found.status.tolist() == [S.INVALID, S.CONVERGED, S.INVALID]
    assert torch.equal(found.q_bar, torch.where(torch.tensor([[True], [False], [True]]), q, found.q_bar))


def test_directions_that_no_sensor_sees_are_counted() -> None:
    for sensors, mode, want in (([0, 1, 2], "pose", 0), ([0, 1], "pose", 3), ([2], "position", 6), ([2], "pose", 3)):
        f = StateFeedback(PCCBackbone(3), PI.cumsum(0)[sensors], mode)
        q = shapes(1, PI, 0.8, generator(3))[0]
        found = f.infer(q, PI, f.backbone.pose(q, PI, *decouple(f.abscissae, PI)))
        assert (int(f.unseen(found)), int(found.feedback.status)) == (want, S.CONVERGED), (sensors, mode)
