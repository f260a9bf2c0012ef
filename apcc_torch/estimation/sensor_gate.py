"""A gate in front of the estimator: which sensors' positions and rotations to believe in a frame, and why not.

Motion capture loses bodies, and mistakes one arrangement of a body's markers for another: the rotation then jumps,
stays wrong for a while and jumps back. The gate judges each frame against the last accepted one, with an allowance that
grows with the time since then, so that an arm that truly moved is found again; and against what an arm can do at all,
for without that the growing allowance would in the end accept a wrong rotation that stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import inf, pi
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie.rotations import is_rotation
from apcc_torch.part import Part, hold_rows, refuse_parameter
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.shapes import batch_shape, check_stamps, check_tensor
from apcc_torch.spread import Numbers, spread


class Reason(IntEnum):
    """Why a position or a rotation was not accepted; the first that holds, in this order.

    Example:
        >>> Reason(6)
        <Reason.JUMP: 6>
    """

    OK = 0
    UNTRACKED = 1  # the source says so
    NON_FINITE = 2  # the pose has a NaN or an infinite entry
    NOT_A_ROTATION = 3  # columns not orthonormal: a zero or non-unit quaternion, or a reflection
    OUT_OF_REACH = 4  # position: farther from the base than the arm is long
    TWISTED = 5  # rotation: twisted about the arm's axis more than an arm that only bends can be
    JUMP = 6  # farther from the last accepted one than the rate limit allows
    TOO_BENT = 7  # rotation: turned against the next accepted sensor towards the base more than the arm can bend


_OK = int(Reason.OK)  # a plain number: torch.compile cannot compare a tensor with an IntEnum


class GateState(NamedTuple):
    """Last accepted poses and their times, position and rotation apart.

    Attributes:
        position: Last accepted positions in m, shape (..., k, 3); zero before the first.
        rotation: Last accepted rotations, shape (..., k, 3, 3); the identity before the first.
        position_time: Their times in s, shape (..., k); minus infinity before the first.
        rotation_time: Their times in s, shape (..., k); minus infinity before the first.
    """

    position: Tensor
    rotation: Tensor
    position_time: Tensor
    rotation_time: Tensor

    def poses(self) -> Tensor:
        """The last accepted poses, (..., k, 4, 4): finite whatever came in, for use where the gate holds one back."""
        top = torch.cat((self.rotation, self.position.unsqueeze(-1)), dim=-1)
        bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
        return torch.cat((top, bottom), dim=-2)


class GateVerdict(NamedTuple):
    """What was accepted, each of shape (..., k): two bool masks and `Reason` codes (int64)."""

    position_ok: Tensor
    orientation_ok: Tensor
    position_reason: Tensor
    orientation_reason: Tensor


def _least_cos(limit: Tensor) -> Tensor:
    """The least cos of an angle up to `limit`; -2, which is below any cos, where any angle is."""
    return torch.where(limit < pi, torch.cos(limit), -2.0)


def _cos_between(a: Tensor, b: Tensor) -> Tensor:
    """The cos of the angle between rotations (..., 3, 3)."""
    return 0.5 * ((a * b).sum((-2, -1)) - 1.0)


@dataclass(frozen=True, kw_only=True)
class JumpSettings(Settings):
    """How far a pose may be from the last accepted one: a margin, and a rate times the time since then."""

    max_speed: float = setting(1.0, "m/s", OURS, "of a position; farther is a jump", above=0)
    position_margin: float = setting(
        0.01, "m", OURS, "that a position may jump at any time: noise, a late frame", least=0
    )
    max_angular_rate: float = setting(8.0, "rad/s", OURS, "of a rotation; farther is a jump", above=0)
    angle_margin: float = setting(0.15, "rad", OURS, "that a rotation may jump at any time", least=0)


@dataclass(frozen=True, kw_only=True)
class SensorGateSettings(JumpSettings):
    """What an arm can do at all; an angle of pi allows any."""

    reach: float | None = setting(
        1.5, "", OURS, "largest distance from the base over a sensor's abscissa; null: any", above=0
    )
    max_bend: Numbers = setting(
        pi / 2, "rad", OURS, "between a sensor and the next one towards the base, one or one a sensor", above=0
    )
    max_twist: Numbers = setting(0.8, "rad", OURS, "about the arm's own axis, one or one a sensor", above=0)
    rotation_tolerance: float = setting(4e-3, "", OURS, "of the entries of R^T R - I", above=0)


class SensorGate(Part):
    """Judges the poses of k sensors along an arm, numbered from the base to the tip, frame by frame.

    Poses are those of `RestCalibration`: in the base frame, z along the resting arm, the identity rotation at rest.
    Before a sensor's first accepted pose nothing is a jump. Where the next sensor towards the base is not accepted in a
    frame, the bend is judged against the one before it, with both limits added. The twist is that of a rotation's split
    into a twist about z followed by a tilt; constant-curvature sections in a row have little of it.

    Args:
        abscissae: (k,) where the sensors sit, m.
        given, changes: Settings.

    Raises:
        ConfigError: A limit is neither a number nor one a sensor.
        ValueRangeError: A limit is out of range.

    Example:
        >>> gate = SensorGate(torch.tensor([0.1, 0.2], dtype=torch.float64), max_speed=2.0)
        >>> T, time = torch.eye(4, dtype=torch.float64).expand(2, 4, 4), torch.zeros((), dtype=torch.float64)
        >>> state, verdict = gate(gate.initial_state(T, time), T, torch.tensor([True, False]), time)
        >>> verdict.position_ok
        tensor([ True, False])
    """

    settings_type = SensorGateSettings

    position_margin: float
    max_speed: float
    angle_margin: float
    max_angular_rate: float
    reach: float | None
    max_bend: Tensor
    max_twist: Tensor
    rotation_tolerance: float
    abscissae: Tensor
    max_reach: Tensor
    identity: Tensor
    least_cos: Tensor  # of the angle between every two frames, the base first, (k + 1, k + 1)

    def __init__(self, abscissae: Tensor, *given: Any, **changes: Any) -> None:
        super().__init__()
        settings = resolved(SensorGateSettings, given, changes)
        self.sensors = check_tensor("abscissae", abscissae, (None,)).shape[-1]
        limits = {name: getattr(settings, name) for name in ("max_bend", "max_twist")}
        for name, value in {"abscissae": abscissae, **limits}.items():
            refuse_parameter(name, value, "a gate's answers have no gradient; hand in a plain tensor")
        with abscissae.device:  # where numbers become tensors
            held = {name: (spread(name, value, self.sensors), 1) for name, value in limits.items()}
        hold_rows(self, abscissae=(abscissae, 1), **held)
        self.hold(settings)

    def derive(self) -> None:
        """Distances and cosines that poses are held against."""
        reach = torch.full_like(self.abscissae, inf) if self.reach is None else self.reach * self.abscissae
        self.register_buffer("max_reach", reach.double(), persistent=False)
        device = self.max_bend.device
        self.register_buffer("identity", torch.eye(3, dtype=torch.float64, device=device), persistent=False)
        i = torch.arange(self.sensors + 1, device=device)
        spanned = (i[: self.sensors] >= i[:, None, None]) & (i[: self.sensors] < i[:, None])  # [lower, upper, bend]
        between = torch.where(spanned | spanned.transpose(0, 1), self.max_bend, 0.0).sum(-1)
        self.register_buffer("least_cos", _least_cos(between), persistent=False)

    def initial_state(self, T: Tensor, time: Tensor) -> GateState:
        """The state before the first frame.

        Args:
            T: A frame's poses, for their shape, dtype and device, shape (..., k, 4, 4).
            time: A time stamp, for its shape and dtype, shape (...).
        """
        check_tensor("T", T, (self.sensors, 4, 4))
        check_stamps("time", check_tensor("time", time, ()))
        batch = batch_shape(T=(T, 3), time=(time, 0))
        never = torch.full((*batch, self.sensors), -inf, dtype=time.dtype, device=time.device)
        eye = torch.eye(3, dtype=T.dtype, device=T.device)
        return GateState(
            T.new_zeros(*batch, self.sensors, 3), eye.expand(*batch, self.sensors, 3, 3).clone(), never, never
        )

    def forward(self, state: GateState, T: Tensor, tracked: Tensor, time: Tensor) -> tuple[GateState, GateVerdict]:
        """Judges one frame.

        Args:
            state: What was accepted before.
            T: Poses in the base frame, shape (..., k, 4, 4); may hold NaN.
            tracked: Which sensors the source saw, bool, shape (..., k).
            time: Time stamp in s, shape (...).

        Returns:
            The state with what was accepted, and the verdict.

        Raises:
            DtypeError, ShapeError: `T` or `time` is not a floating tensor of its shape.
        """
        check_tensor("T", T, (self.sensors, 4, 4))
        now = check_tensor("time", time, ()).unsqueeze(-1)
        R, p = T[..., :3, :3], T[..., :3, 3]
        finite = T[..., :3, :].isfinite().flatten(-2).all(-1)
        # From here on every number is finite: what is not is replaced by what was held, and its reason stands.
        R = torch.where(finite[..., None, None], R, state.rotation)
        p = torch.where(finite[..., None], p, state.position)
        improper = ~is_rotation(R, self.rotation_tolerance)
        common = ((Reason.UNTRACKED, ~tracked), (Reason.NON_FINITE, ~finite), (Reason.NOT_A_ROTATION, improper))

        waited = (now - state.position_time).clamp(min=0.0).to(p.dtype)
        allowed = self.position_margin + self.max_speed * waited
        far = torch.linalg.vector_norm(p, dim=-1) > self.max_reach.to(p)
        jump = torch.linalg.vector_norm(p - state.position, dim=-1) > allowed
        position_reason = _first((*common, (Reason.OUT_OF_REACH, far), (Reason.JUMP, jump)))

        waited = (now - state.rotation_time).clamp(min=0.0).to(p.dtype)
        allowed = self.angle_margin + self.max_angular_rate * waited
        twist = torch.atan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1]).abs()
        jump = _cos_between(R, state.rotation) < _least_cos(allowed)
        reason = _first((*common, (Reason.TWISTED, twist > self.max_twist.to(p)), (Reason.JUMP, jump)))
        orientation_reason = self._with_bend(R, reason)

        position_ok, orientation_ok = position_reason == _OK, orientation_reason == _OK
        state = GateState(
            torch.where(position_ok.unsqueeze(-1), p, state.position),
            torch.where(orientation_ok[..., None, None], R, state.rotation),
            torch.where(position_ok, now, state.position_time),
            torch.where(orientation_ok, now, state.rotation_time),
        )
        return state, GateVerdict(position_ok, orientation_ok, position_reason, orientation_reason)

    def _with_bend(self, R: Tensor, reason: Tensor) -> Tensor:
        """The reasons (..., k), with TOO_BENT where all else was well; from the base on, as each leans on the last."""
        base = self.identity.to(R).expand(*R.shape[:-3], 1, 3, 3)
        flat = torch.cat((base, R), dim=-3).flatten(-2)
        # Between every two frames, the base first: is the angle more than the bends between them allow?
        too_bent = 0.5 * (flat @ flat.mT - 1.0) < self.least_cos.to(R)
        well = reason == _OK
        below = too_bent[..., 0, :]
        rejected = []
        for k in range(self.sensors):
            bent = below[..., k + 1]
            rejected.append(bent)
            below = torch.where((well[..., k] & ~bent).unsqueeze(-1), too_bent[..., k + 1, :], below)
        return reason.masked_fill(torch.stack(rejected, dim=-1) & well, int(Reason.TOO_BENT))


def _first(checks: Sequence[tuple[Reason, Tensor]]) -> Tensor:
    """The code of the first check that holds, Reason.OK where none does."""
    code = torch.zeros_like(checks[-1][1], dtype=torch.int64)
    for reason, applies in reversed(checks):
        code = code.masked_fill(applies, int(reason))
    return code


def gate_recording(gate: SensorGate, T: Tensor, tracked: Tensor, times: Tensor) -> tuple[Tensor, GateVerdict]:
    """Runs the gate over a whole recording.

    Args:
        gate: The gate.
        T: Poses in the base frame, shape (N, k, 4, 4).
        tracked: Which sensors the source saw, bool, shape (N, k).
        times: Time stamps in s, shape (N,).

    Returns:
        The poses with the last accepted ones held where one was not accepted, shape (N, k, 4, 4), and the verdicts,
        each of shape (N, k).

    Example:
        >>> gate, T = SensorGate(torch.tensor([0.3]).double()), torch.eye(4).double().repeat(3, 1, 1, 1)
        >>> T[1, 0, 0, 3] = 0.4
        >>> times, tracked = torch.tensor([0.0, 0.01, 0.02]).double(), torch.ones(3, 1).bool()
        >>> held, verdict = gate_recording(gate, T, tracked, times)
        >>> held[:, 0, 0, 3], [Reason(int(each)).name for each in verdict.position_reason]
        (tensor([0., 0., 0.], dtype=torch.float64), ['OK', 'JUMP', 'OK'])
    """
    state = gate.initial_state(T[0], times[0])
    held, verdicts = [], []
    for i in range(len(T)):
        state, verdict = gate(state, T[i], tracked[i], times[i])
        held.append(state.poses())
        verdicts.append(verdict)
    return torch.stack(held), GateVerdict(*(torch.stack(parts) for parts in zip(*verdicts, strict=True)))
