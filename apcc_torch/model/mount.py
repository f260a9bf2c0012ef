"""Rigid mounts: a chain of rigid joints from a URDF (a fixed flange, a gantry, a six-axis arm) that carries the arm.

The whole body's configuration is s = (joints, q), (..., m + n). With T_m(joints) the mount's flange in the world, a
material point of the arm is T_m h(q, X_tilde, pi), and its body twist

    J_b = (Ad_{h^-1} J_m,  J_soft),

J_m the mount's body Jacobian at the flange. The rigid chain itself is pytorch-kinematics'.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytorch_kinematics as pk
import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.files import read_text
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.urdf import RigidJoint, joints_between
from apcc_torch.part import Part, hold_rows
from apcc_torch.shapes import batch_shape, check_same, check_tensor

MOST_JOINTS = 100
"""Of a chain, fixed ones too: the library copies, once a joint, all that hangs on it."""


class RigidMount(Part):
    """A serial chain of m rigid joints between a URDF's base link and the flange that carries the arm.

    Joint values are (..., m): rad for revolute and continuous joints, m for prismatic ones, in the chain's order. First
    and second derivatives by the joints are exact under autograd.

    Args:
        urdf: The URDF's text, or a path to it.
        end_link: Name of the link that is the flange.
        root_link: Name of the link at which the chain begins; None for the URDF's root.
        placement: (..., 4, 4) pose of that link in the world; None for the identity.

    Raises:
        DataError: The text is not a URDF, or a joint in between is none that a mount can have; see `model.urdf`.
        ConfigError: A link's name is unknown, or no chain leads from one to the other.
    """

    placement: Tensor
    lower: Tensor
    upper: Tensor
    velocity: Tensor

    def __init__(
        self, urdf: str | Path, end_link: str, root_link: str | None = None, placement: Tensor | None = None
    ) -> None:
        super().__init__()
        self.urdf = _text_of(urdf) if isinstance(urdf, Path) else urdf
        self.end_link, self.root_link = end_link, root_link
        self.derive()
        if placement is None:
            placement = torch.eye(4, dtype=torch.float64)
        check_tensor("placement", placement, (4, 4))
        hold_rows(self, placement=(placement, 2))
        for name in ("lower", "upper", "velocity"):
            values = [getattr(joint, name) for joint in self._joints]
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))

    def derive(self) -> None:
        """The chain."""
        with torch.device("cpu"):  # whatever the default device is: the library reads values
            joints = joints_between(self.urdf, self.root_link, self.end_link)
            self._chain = _serial_chain(joints)
        self._joints = [joint for joint in joints if joint.moves != "fixed"]
        # The chain keeps its constants to itself; one copy serves each dtype and device that it is asked for in.
        self._copies = {(torch.float64, torch.device("cpu")): self._chain}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_joints", "_chain", "_copies")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.derive()

    def extra_repr(self) -> str:
        """What the chain connects."""
        return f"end_link={self.end_link!r}, joints={self.joint_names}"

    @property
    def n_joints(self) -> int:
        """Number of joints m."""
        return len(self.joint_names)

    @property
    def joint_names(self) -> list[str]:
        """The joints' names, in order."""
        return [joint.name for joint in self._joints]

    def pose_and_body_jacobian(self, joints: Tensor) -> tuple[Tensor, Tensor]:
        """The flange's pose (..., 4, 4), world frame, and body Jacobian (..., 6, m), angular rows first.

        Args:
            joints: (..., m).

        Raises:
            ShapeError, DtypeError: joints is not (..., m) floats.
        """
        frames, geometric = self._links(joints)
        end = frames[self._chain._serial_eef_frame_idx]
        into_flange = end[..., :3, :3].mT
        body = torch.cat((into_flange @ geometric[..., 3:, :], into_flange @ geometric[..., :3, :]), dim=-2)
        return self.placement.to(end) @ end, body

    def link_positions(self, joints: Tensor) -> Tensor:
        """Origins (..., k, 3) of all links of the chain, base first, world frame, m: for drawings."""
        frames, _ = self._links(joints)
        return (self.placement.to(joints).unsqueeze(-3) @ torch.stack(frames.unbind(0), dim=-3))[..., :3, 3]

    def rate_bounds(self, joints: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Smallest and largest joint rates (..., m) that keep speeds and, dt s later, positions inside their limits.

        A joint that is outside its limits is asked back, as fast as its speed limit allows.
        """
        fastest = self.velocity.to(joints)
        low, high = ((limit.to(joints) - joints) / dt for limit in (self.lower, self.upper))
        return torch.clamp(low, -fastest, fastest), torch.clamp(high, -fastest, fastest)

    def _links(self, joints: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (k, ..., 4, 4) of all links in the base link's frame, and the geometric Jacobian (..., 6, m)."""
        check_tensor("joints", joints, (self.n_joints,))
        chain = self._in(joints)
        flat = joints.reshape(joints.shape[:-1].numel(), self.n_joints)
        frames = chain.forward_kinematics_tensor(flat, analytical_grad=False)
        geometric = chain.jacobian_tensor(flat, all_transforms=frames)
        batch = joints.shape[:-1]
        return frames.reshape(len(frames), *batch, 4, 4), geometric.reshape(*batch, 6, self.n_joints)

    def _in(self, like: Tensor) -> pk.SerialChain:
        """The chain in a tensor's dtype and on its device."""
        key = (like.dtype, like.device)
        if key not in self._copies:
            self._copies[key] = _copied(self._chain, *key)
        return self._copies[key]


class MountedArm(Part):
    """A soft arm on a rigid mount, as one body with configuration s = (joints, q), (..., m + n).

    Its points have poses and body Jacobians as those of a `KinematicModel`, so task stacks and clearance take it as it
    is. The arm's own world is the flange: its base rotation turns it there.

    Args:
        mount: The rigid chain.
        arm: The soft arm.
    """

    def __init__(self, mount: RigidMount, arm: KinematicModel) -> None:
        super().__init__()
        self.mount = mount
        self.arm = arm

    @property
    def n(self) -> int:
        """Number of coordinates, m + n."""
        return self.mount.n_joints + self.arm.n

    @property
    def n_sections(self) -> int:
        """Number of soft sections n_b."""
        return self.arm.n_sections

    def split(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """s (..., m + n) -> joints (..., m) and q (..., n).

        Raises:
            ShapeError, DtypeError: s is not (..., m + n) floats.
        """
        check_tensor("s", s, (self.n,))
        joints, q = s.split_with_sizes((self.mount.n_joints, self.arm.n), dim=-1)
        return joints, q

    def pose_and_body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., k, 4, 4), world frame, and body Jacobians (..., k, 6, m + n) of material points.

        Args:
            q: (..., m + n) the whole body's s.
            L0: (..., n_b) rest lengths, m.
            X_tilde: (..., k) normalised abscissa in its section, from `decouple`.
            j: (..., k) int64 zero-based section index.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        joints, soft = self.split(q)
        check_same(q=q, L0=L0)
        flange, J_m = self.mount.pose_and_body_jacobian(joints)
        on_arm, J_soft = self.arm.pose_and_body_jacobian(soft, L0, X_tilde, j)
        batch = batch_shape(q=(q, 1), on_arm=(on_arm, 3))
        k = X_tilde.shape[-1]
        carried = se3.adjoint(se3.inverse(on_arm)) @ J_m.unsqueeze(-3)
        parts = (carried.expand(*batch, k, 6, -1), J_soft.expand(*batch, k, 6, -1))
        return flange.unsqueeze(-3) @ on_arm, torch.cat(parts, dim=-1)

    def body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """J_b (..., k, 6, m + n) of material points, such as sensors; see `pose_and_body_jacobian`."""
        return self.pose_and_body_jacobian(q, L0, X_tilde, j)[1]

    def tip_pose(self, q: Tensor, L0: Tensor) -> Tensor:
        """Pose of the tip (..., 4, 4), world frame, at s (..., m + n)."""
        return self._tip(q, L0)[0]

    def tip(self, q: Tensor, L0: Tensor) -> Tensor:
        """Tip position (..., 3) m, world frame, at s (..., m + n)."""
        return self.tip_pose(q, L0)[..., :3, 3]

    def tip_jacobian(self, q: Tensor, L0: Tensor) -> Tensor:
        """J (..., 3, m + n): the tip's velocity is J sdot, world axes."""
        T, J_b = self._tip(q, L0)
        return T[..., :3, :3] @ J_b[..., 3:, :]

    def points(self, q: Tensor, L0: Tensor, N: int, spacing: str = "arc") -> Tensor:
        """N points along the soft arm, (..., N, 3) m, world frame; as `KinematicModel.points`."""
        joints, soft = self.split(q)
        flange, _ = self.mount.pose_and_body_jacobian(joints)
        p = self.arm.points(soft, L0, N, spacing)
        return p @ flange[..., :3, :3].mT + flange[..., None, :3, 3]

    def rate_bounds(self, q: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """`RigidMount.rate_bounds` for s (..., m + n); the soft coordinates have none."""
        joints, soft = self.split(q)
        none = torch.full_like(soft, torch.inf)
        low, high = self.mount.rate_bounds(joints, dt)
        return torch.cat((low, -none), dim=-1), torch.cat((high, none), dim=-1)

    def _tip(self, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        X_tilde, j = decouple(L0.cumsum(-1)[..., -1:], L0)
        T, J_b = self.pose_and_body_jacobian(q, L0, X_tilde, j)
        return T[..., 0, :, :], J_b[..., 0, :, :]


def _text_of(path: Path) -> str:
    return read_text(path, name=f"the mount's URDF {path}").removeprefix("\ufeff")


def _serial_chain(joints: list[RigidJoint]) -> pk.SerialChain:
    """The library's chain in float64. Its links are numbered: what their names are is none of its business."""
    if len(joints) > MOST_JOINTS:
        raise DataError(f"the mount's URDF has {len(joints)} joints in a row, and may have {MOST_JOINTS}")
    frame = root = pk.Frame("0", pk.Link("0"))
    for k, joint in enumerate(joints, 1):
        offset = pk.Transform3d(matrix=joint.origin.unsqueeze(0), dtype=torch.float64)
        below = pk.Frame(str(k), pk.Link(str(k)), pk.Joint(str(k), offset, joint.moves, joint.axis, torch.float64))
        below.joint.axis = joint.axis  # as it is, not made of length 1 once more
        frame.children = [below]
        frame = below
    return pk.SerialChain(pk.Chain(root, torch.float64), frame.name, dtype=torch.float64)


def _copied(chain: pk.SerialChain, dtype: torch.dtype, device: torch.device) -> pk.SerialChain:
    """The chain anew in another dtype or on another device; the library changes chains in place."""
    with torch.device("cpu"):
        copied = pk.SerialChain(chain, chain._serial_frames[-1].name, dtype=torch.float64)
    return copied.to(dtype=dtype, device=device)
