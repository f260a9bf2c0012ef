"""A filter of the sensors' poses that does not lag: the commanded motion carries them on from reading to reading.

Algorithm 2 has no memory, so what its sensors add to a pose goes through it into q_bar, and from there, through a stiff
null-space term, into the arm. A low-pass of the poses would take the noise away and be late, which a stiff loop does
not bear. Here the poses first move as the model says that they do, and only what that leaves is filtered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import MaterialPoints
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part
from apcc_torch.settings import MANY, OURS, Setting, Settings, aligned, resolved, setting

LONG_AGO = 1e9
"""s since the last reading of a sensor that was never read."""

AT_ONCE = 1e-9
"""s, a time constant that leaves nothing of the prediction."""


class PoseFilterState(NamedTuple):
    """Where the sensors are expected.

    T: (..., k, 4, 4) their poses in the next reading, as far as the commanded motion tells.
    age: (..., k, 2) s since orientation and position were last read; `LONG_AGO` before the first reading.
    since: (..., delay, k, 4, 4) the motions exp(xi) commanded since that reading was taken, the oldest first.
    """

    T: Tensor
    age: Tensor
    since: Tensor


@dataclass(frozen=True, kw_only=True)
class PoseFilterSettings(Settings):
    """Settings of `PoseFilter`."""

    angular_time: Setting = setting(
        0.0, "s", OURS, "time constant of the orientations; 0: as measured", rows="number", least=0
    )
    linear_time: Setting = setting(
        0.0, "s", OURS, "time constant of the positions; 0: as measured", rows="number", least=0
    )
    follow: Setting = setting(
        0.8, "", OURS, "the share of its commanded motion that the arm makes at once", rows="number", least=0
    )
    delay: int = setting(0, "", OURS, "periods by which readings are late", least=0, most=MANY)


class PoseFilter(Part):
    """Complementary filter of sensor poses: T = T_pred exp(alpha log(T_pred^-1 T_meas)), part by part, with

        T_pred <- T exp(follow J_s(q_bar, pi_hat) dq_d),    alpha = 1 - exp(-age / time).

    The correction is that of a constant-gain filter on SE(3) (Mahony, Hamel and Pflimlin 2008), the prediction that of
    the model whose tendons have moved by dq_d. An arm that is soft does not move by all of it, which `follow` says.

    A reading that is `delay` periods old is expected where the arm was then, and its filtered pose is carried on by the
    motion commanded since, T exp(xi_1) ... exp(xi_delay): the predictor of Smith (1957), with the model for the plant.

    A part that is not measured is not changed in the reading: its masks stay what they are. The prediction of it goes
    on, and when it is measured again, the longer it was not, the less counts the prediction.

    Args:
        *settings, **changes: See `PoseFilterSettings`; each number but the delay may be a tensor (...), one a row.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> state = PoseFilter(delay=2).initial_state(torch.zeros(4, 9), k=3)
        >>> state.T.shape, state.since.shape
        (torch.Size([4, 3, 4, 4]), torch.Size([4, 2, 3, 4, 4]))
    """

    settings_type = PoseFilterSettings
    angular_time: Setting
    linear_time: Setting
    follow: Setting
    delay: int

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(PoseFilterSettings, settings, changes))

    def initial_state(self, q: Tensor, k: int) -> PoseFilterState:
        """Before the first reading of k sensors, of the batch of q (..., n)."""
        T = torch.eye(4, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], k, 4, 4)
        still = T.unsqueeze(-4).expand(*q.shape[:-1], self.delay, k, 4, 4)
        return PoseFilterState(T, torch.full_like(T[..., :2, 0], LONG_AGO), still)

    def forward(
        self, state: PoseFilterState, T: Tensor, usable: Tensor, oriented: Tensor, dt: Tensor
    ) -> tuple[PoseFilterState, Tensor]:
        """The filtered poses of now, with a state that is still where the sensors were: `moved` carries it on.

        Args:
            state: From `initial_state` or `moved`.
            T: (..., k, 4, 4) measured poses.
            usable: (..., k) bool, sensors that are measured.
            oriented: (..., k) bool, sensors whose orientations are.
            dt: (...) s since the last reading.

        Returns:
            The state, and the poses (..., k, 4, 4); of sensors that are not usable, T as it is.
        """
        age = state.age + dt[..., None, None]
        expected, p_expected = state.T[..., :3, :3], state.T[..., :3, 3]
        seen, placed = oriented[..., None, None], usable[..., None]
        R = torch.where(seen, T[..., :3, :3], expected)
        p = torch.where(placed, T[..., :3, 3], p_expected)
        # From the measurement back: a product of many predictions would not stay a rotation.
        off = so3.log(expected.mT @ R)
        R_new = R @ so3.exp(-self._left(age[..., :1], self.angular_time) * off)
        p_new = p + self._left(age[..., 1:], self.linear_time) * (p_expected - p)
        read = torch.stack((oriented, usable), dim=-1)
        later = PoseFilterState(se3.pose(R_new, p_new), torch.where(read, 0.0, age), state.since)
        now = later.T
        for i in range(self.delay):
            now = now @ state.since[..., i, :, :, :]
        filtered = se3.pose(torch.where(seen, now[..., :3, :3], T[..., :3, :3]), now[..., :3, 3])
        return later, torch.where(placed.unsqueeze(-1), filtered, T)

    def moved(
        self, state: PoseFilterState, backbone: KinematicModel, points: MaterialPoints, q: Tensor, change: Tensor
    ) -> PoseFilterState:
        """The state at the next reading, once the command has changed.

        Args:
            state: From `forward`.
            backbone: The model.
            points: (..., k) where on it the sensors are.
            q: (..., n) q_bar.
            change: (..., n) dq_d.
        """
        chain = backbone.chain_to(q, points)
        # An orientation that was never read is the model's at the reading: it tells which way the position moves.
        R = chain.rotation
        for i in reversed(range(self.delay)):
            R = R @ state.since[..., i, :, :3, :3].mT
        R = torch.where(state.age[..., 0, None, None] < LONG_AGO, state.T[..., :3, :3], R)
        J = chain.body_jacobian()
        twist = (J @ (aligned(self.follow, 1) * change)[..., None, :, None]).squeeze(-1)
        since = torch.cat((state.since, se3.exp(twist).unsqueeze(-4)), dim=-4)
        T = se3.pose(R, state.T[..., :3, 3]) @ since[..., 0, :, :, :]
        return state._replace(T=T, since=since[..., 1:, :, :, :])

    @staticmethod
    def _left(age: Tensor, time: Setting) -> Tensor:
        """1 - alpha (..., k, 1), the share of the prediction."""
        constant = aligned(time, 2)
        slow = constant.clamp(min=AT_ONCE) if isinstance(constant, Tensor) else max(constant, AT_ONCE)
        return torch.exp(-age / slow)
