"""The whole body against autograd, against the backbone alone, and the rigid chain against its joints written out."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from apcc_torch.errors import ConfigError, DataError, DtypeError, ShapeError
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.mount import MountedArm, RigidMount
from arms import HANGING_BASE, configurations, rest_lengths
from laws import check_batching, check_gradients, generator, poses, uniform

GANTRY = Path(__file__).parents[2] / "examples" / "urdf" / "gantry.urdf"

SIX_AXES = "".join(
    f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
    f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
    '<limit lower="-2.5" upper="2.5" velocity="2" effort="1"/></joint>'
    for k, (xyz, rpy, axis) in enumerate(
        (
            ("0 0 0.34", "0 0 0", "0 0 1"),
            ("0.03 0 0.1", "0 0.4 0", "0 1 0"),
            ("0 0 0.41", "0 0 0", "0 1 0.2"),
            ("0.2 0 0.03", "1.2 0 -0.7", "1 0 0"),
            ("0.2 0 0", "0 0 0", "0 1 0"),
            ("0.07 0 0", "0.3 0.2 0.1", "1 0 0"),
        )
    )
)
URDF = f'<robot name="r">{"".join(f"<link name={chr(34)}l{k}{chr(34)}/>" for k in range(7))}{SIX_AXES}</robot>'
FIXED = (
    '<robot name="f"><link name="base"/><link name="flange"/><joint name="bolts" type="fixed"><parent link="base"/>'
    '<child link="flange"/><origin xyz="0.1 0.2 0.3" rpy="3.141592653589793 0 0"/></joint></robot>'
)


def six_axes() -> RigidMount:
    return RigidMount(URDF, "l6")


def body(rng: torch.Generator, rows: int = 8) -> tuple[MountedArm, Tensor, Tensor]:
    """A three-section arm on six axes, its s (rows, 15) and rest lengths (rows, 3)."""
    arm = MountedArm(six_axes(), PCCBackbone(3, HANGING_BASE))
    joints = uniform((rows, 6), -2.0, 2.0, torch.float64, rng)
    s = torch.cat((joints, configurations((rows,), 3, torch.float64, rng)), dim=-1)
    return arm, s, rest_lengths((rows,), 3, torch.float64, rng)


def test_a_fixed_mount_is_a_base_rotation() -> None:
    rng = generator(1)
    q, L0 = configurations((10,), 3, torch.float64, rng), rest_lengths((10,), 3, torch.float64, rng)
    mount = RigidMount(FIXED, "flange")
    assert mount.n_joints == 0
    arm, hung = MountedArm(mount, PCCBackbone(3)), PCCBackbone(3, HANGING_BASE)
    shift = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    torch.testing.assert_close(arm.tip(q, L0), hung.tip(q, L0) + shift, rtol=0, atol=1e-12)
    torch.testing.assert_close(arm.tip_jacobian(q, L0), hung.tip_jacobian(q, L0), rtol=0, atol=1e-12)
    torch.testing.assert_close(arm.points(q, L0, 9), hung.points(q, L0, 9) + shift, rtol=0, atol=1e-12)
    at = decouple(torch.tensor([0.05, 0.2, 0.31], dtype=torch.float64), L0)
    torch.testing.assert_close(arm.body_jacobian(q, L0, *at), hung.body_jacobian(q, L0, *at), rtol=0, atol=1e-12)


def test_the_gantry_is_its_joints() -> None:
    mount = RigidMount(GANTRY, "flange")
    assert mount.joint_names == ["x_rail", "y_rail", "z_lift", "turn"]
    torch.testing.assert_close(mount.lower[:3], torch.tensor([-0.6, -0.4, 0.0], dtype=torch.float64))
    torch.testing.assert_close(mount.velocity[2], torch.tensor(0.15, dtype=torch.float64))
    joints = uniform((6, 4), -0.3, 0.3, torch.float64, generator(2))
    x, y, z, turn = joints.unbind(-1)
    T, J = mount.pose_and_body_jacobian(joints)
    zero = torch.zeros_like(turn)
    R = so3.exp(torch.stack((zero, zero, turn), dim=-1)) @ HANGING_BASE
    torch.testing.assert_close(T, se3.pose(R, torch.stack((x, y, 1.5 - 0.17 - z), dim=-1)), rtol=0, atol=1e-12)
    down = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(J[:, 3:, 2], down.expand(6, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(J[:, :3, 3], -down.expand(6, 3), rtol=0, atol=1e-12)
    links = mount.link_positions(joints)
    assert links.shape == (6, 6, 3)
    torch.testing.assert_close(links[:, -1], T[:, :3, 3])


def test_the_six_axes_are_a_product_of_turns() -> None:
    joints = uniform((5, 6), -2.0, 2.0, torch.float64, generator(3))
    want = torch.eye(4, dtype=torch.float64)
    frames = (
        ((0, 0, 0.34), (0, 0, 0), (0, 0, 1)),
        ((0.03, 0, 0.1), (0, 0.4, 0), (0, 1, 0)),
        ((0, 0, 0.41), (0, 0, 0), (0, 1, 0.2)),
        ((0.2, 0, 0.03), (1.2, 0, -0.7), (1, 0, 0)),
        ((0.2, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((0.07, 0, 0), (0.3, 0.2, 0.1), (1, 0, 0)),
    )
    for k, (xyz, rpy, axis) in enumerate(frames):
        R = torch.eye(3, dtype=torch.float64)
        for i in (2, 1, 0):
            R = R @ torch.matrix_exp(so3.hat(torch.eye(3, dtype=torch.float64)[i] * rpy[i]))
        direction = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=-1)
        turn = torch.matrix_exp(so3.hat(direction * joints[:, k, None]))
        want = want @ se3.pose(R @ turn, torch.tensor(xyz, dtype=torch.float64).expand(5, 3))
    torch.testing.assert_close(six_axes().pose_and_body_jacobian(joints)[0], want, rtol=0, atol=1e-12)


def test_jacobians_are_the_derivatives_of_poses() -> None:
    # Row by row: pytorch-kinematics writes in place, which torch.func's vmap does not allow.
    arm, s, L0 = body(generator(4), rows=3)
    X_tilde, j = decouple(torch.tensor([0.04, 0.2, 0.33], dtype=torch.float64), L0)
    T, J_b = arm.pose_and_body_jacobian(s, L0, X_tilde, j)
    J = arm.tip_jacobian(s, L0)
    for i in range(3):
        torch.testing.assert_close(J[i], jacobian(lambda v, i=i: arm.tip(v, L0[i]), s[i]), rtol=0, atol=1e-11)

        def pose(v: Tensor, i: int = i) -> Tensor:
            return arm.pose_and_body_jacobian(v, L0[i], X_tilde[i], j[i])[0]

        rate = jacobian(pose, s[i])  # (k, 4, 4, n)
        twist = se3.vee(se3.inverse(T[i]).unsqueeze(-3) @ rate.movedim(-1, -3))  # (k, n, 6)
        torch.testing.assert_close(J_b[i], twist.mT, rtol=0, atol=1e-11)
    torch.testing.assert_close(arm.tip_pose(s, L0)[..., :3, 3], arm.points(s, L0, 5)[:, -1], rtol=0, atol=1e-12)


def test_second_derivatives() -> None:
    arm, s, L0 = body(generator(5), rows=1)
    check_gradients(lambda s: arm.tip(s, L0), s)


def test_what_has_no_limit_is_free() -> None:
    text = (
        '<robot name="r"><link name="a"/><link name="b"/><link name="c"/>'
        '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><limit velocity="2" effort="1"/></joint>'
        '<joint name="k" type="continuous"><parent link="b"/><child link="c"/></joint></robot>'
    )
    mount = RigidMount(text, "c")
    assert mount.lower.tolist() == [-torch.inf, -torch.inf] and mount.upper.tolist() == [torch.inf, torch.inf]
    low, high = mount.rate_bounds(torch.tensor([9.0, 9.0], dtype=torch.float64), 0.01)
    assert high.tolist() == [2.0, torch.inf] and low.tolist() == [-2.0, -torch.inf]


def test_placement_moves_the_whole() -> None:
    rng = generator(6)
    arm, s, L0 = body(rng)
    place = poses((), torch.float64, rng)
    moved = MountedArm(RigidMount(URDF, "l6", placement=place), arm.arm)
    torch.testing.assert_close(moved.tip_pose(s, L0), place @ arm.tip_pose(s, L0), rtol=0, atol=1e-12)
    whole = torch.cat((arm.points(s, L0, 7), torch.ones(8, 7, 1, dtype=torch.float64)), dim=-1)
    torch.testing.assert_close(moved.points(s, L0, 7), (whole @ place.mT)[..., :3], rtol=0, atol=1e-12)


def test_rate_bounds_keep_the_joints_inside() -> None:
    mount = RigidMount(GANTRY, "flange")
    joints = torch.tensor([[0.59, -0.5, 0.1, 0.0], [0.0, 0.4, 0.3, 3.0]], dtype=torch.float64)
    low, high = MountedArm(mount, PCCBackbone(1)).rate_bounds(torch.nn.functional.pad(joints, (0, 3)), 0.1)
    assert bool((high[:, 4:] == torch.inf).all()) and bool((low[:, 4:] == -torch.inf).all())
    later = joints + 0.1 * high[:, :4]
    torch.testing.assert_close(high[0, 0], torch.tensor(0.1, dtype=torch.float64))
    inside = (joints >= mount.lower) & (joints <= mount.upper)
    assert bool((later <= mount.upper + 1e-12)[inside].all())
    assert bool(((joints + 0.1 * low[:, :4]) >= mount.lower - 1e-12)[inside].all())
    # The one outside moves back at its top speed, whatever is asked.
    torch.testing.assert_close(low[0, 1], torch.tensor(0.25, dtype=torch.float64))
    assert bool((low <= high).all())


def test_leading_dimensions_are_a_batch() -> None:
    arm = MountedArm(six_axes(), PCCBackbone(2))

    def inputs(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        s = torch.cat((uniform((*shape, 6), -1, 1, dtype, rng), configurations(shape, 2, dtype, rng)), dim=-1)
        return s, rest_lengths(shape, 2, dtype, rng)

    check_batching(lambda s, L0: (arm.tip_pose(s, L0), arm.tip_jacobian(s, L0)), inputs, shared=(1,))


def test_refusals() -> None:
    with pytest.raises(DataError, match="not a URDF"):
        RigidMount("no xml", "flange")
    with pytest.raises(DataError, match="not a URDF"):
        RigidMount('<robot name="r"/>', "flange")
    with pytest.raises(ConfigError, match="no link hand; it has"):
        RigidMount(GANTRY, "hand")
    with pytest.raises(ConfigError, match="no link hand"):
        RigidMount(GANTRY, "flange", root_link="hand")
    arm, s, L0 = body(generator(7))
    with pytest.raises(ShapeError, match=r"s must have shape \(\.\.\., 15\)"):
        arm.tip(s[:, :9], L0)
    with pytest.raises(DtypeError, match="is torch"):
        arm.tip(s, L0.float())
