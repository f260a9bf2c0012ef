"""The A-PCC controller with a look ahead: Eq. (16), and a departure from it where rollouts say that this is better."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from apcc_torch.control.ahead import Ahead, AheadStatus
from apcc_torch.control.asked import Asked
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead import Lookahead
from apcc_torch.control.lookahead_refusal import LookaheadRefusal
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.control.obstacles import Obstacle
from apcc_torch.control.predicted_loop import Outlook, Predicted, PredictedLoop
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target, elapsed
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.model.abscissae import decouple, section_fractions
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.native.compiled import Step, compiled
from apcc_torch.part import part_of, row_tensors

PRIOR = 1e-3
"""How much a payload of nothing is believed before anything is seen, as an elastic energy over time, J s/kg^2: a few
steps of a hanging arm are more."""


class LookaheadController(APCCController):
    """`APCCController` whose command may depart from Eq. (16), as a look ahead said after the step before.

    A step takes no longer for it: `forward` uses the departure that waits in the state, if there is one, and
    `look_ahead` finds the next while the arm moves. A state that was not looked ahead from, because a deadline was
    near, steps as Eq. (16) alone; `state.ahead.status` says which it was.

    Args:
        *parts: As in `APCCController`; with a routing, and a model of constant-curvature sections.
        of: The arm that is looked ahead for, of as many sections.
        lookahead: How to look ahead.
        obstacles: To be kept clear of, beside the settings' own.
        **settings: As in `APCCController`.

    Raises:
        ConfigError: There is no routing, or the model is none of constant-curvature sections, or the arm has chambers,
            or settings differ from row to row.

    Example:
        >>> arm, still = Arm(lengths=[0.2, 0.25], mass=0.4), torch.zeros(6).double()
        >>> settings = LookaheadSettings(samples=8, steps=3)
        >>> controller = LookaheadController.for_arm(arm, adaptation=None, lookahead=settings)
        >>> L0, target = arm.rest_lengths(), Target(torch.tensor([0.1, 0.0, -0.4]).double(), torch.zeros(3).double())
        >>> T = arm.backbone().pose(still, L0, *decouple(arm.sensor_places(), L0))
        >>> state = controller.initial_state(still, L0)
        >>> state, command = controller(state, Measurement(T, torch.tensor(0.02).double()), target)
        >>> state = controller.look_ahead(state, target)  # while the arm moves
        >>> int(state.ahead.number), state.ahead.knots.shape
        (1, torch.Size([3, 9]))
    """

    def __init__(
        self,
        *parts: Any,
        of: Arm,
        lookahead: LookaheadSettings | None = None,
        obstacles: Sequence[Obstacle] = (),
        **settings: Any,
    ) -> None:
        super().__init__(*parts, **settings)
        s = LookaheadSettings() if lookahead is None else lookahead
        LookaheadRefusal.NO_TENDONS.check(self.routing is None)
        LookaheadRefusal.CHAMBERS.check(self.pressure is not None)
        LookaheadRefusal.MODEL.check(not isinstance(self.backbone, PCCBackbone))
        assert isinstance(self.backbone, PCCBackbone) and self.routing is not None  # refused otherwise
        # A shape is known in pieces of the sections, and what the load does to them moves the tip by centimetres.
        with self.backbone.base_rotation.device:  # where numbers become tensors
            dynamics = of.dynamics(1 if self.shape is None else self.shape.shape.refine)
        model = self.backbone, self.inverse_kinematics, dynamics, self.routing
        loop = PredictedLoop(
            *model,
            s,
            obstacles=obstacles,
            bend_bound=self.bend_bound,
            elongation_bound=self.elongation_bound,
            reference_damping=self.reference_damping,
        )
        self.lookahead: Lookahead = part_of(s)(loop, s)
        self.rate_time, self.payload_limit = max(s.rate_time, 1e-9), s.payload_limit
        self.observer_gain, self.payload_time, self.force_time = s.observer_gain, s.payload_time, s.force_time
        LookaheadRefusal.ROWS.check(bool(row_tensors(self.lookahead)))

    @classmethod
    def on(cls, arm: Arm, control: ControlSettings, nominal: Tensor | None = None, **parts: Any) -> Self:
        """See `APCCController.on`."""
        return super().on(arm, control, nominal, of=arm, lookahead=control.lookahead, **parts)

    def initial_state(self, q: Tensor, pi_hat: Tensor, time: Tensor | None = None) -> ControllerState:
        """See `APCCController.initial_state`."""
        state = super().initial_state(q, pi_hat, time)
        zero, q = torch.zeros_like(state.q_bar[..., 0]), self._pieces(state, state.pi_hat)
        none = torch.zeros_like(zero, dtype=torch.int64)
        knots = zero[..., None, None].expand(*zero.shape, self.lookahead.knots, 3 + self.backbone.n)
        y = self.tendons(state.q_d, state.pi_hat)
        assert y is not None  # there is a routing
        still, rest, x = torch.zeros_like(y), torch.zeros_like(q), self.backbone.tip(state.q_bar, state.pi_hat)
        ahead = Ahead(
            knots, zero, none, none, none, q, rest, rest, x, y, still, still, rest, rest, zero, zero, rest, zero, none
        )
        return state._replace(ahead=ahead)

    def forward(
        self, state: ControllerState, measurement: Measurement, target: Target
    ) -> tuple[ControllerState, Command]:
        """One control step; see `APCCController.forward`."""
        later, command = super().forward(state, measurement, target)
        ahead = state.ahead
        assert ahead is not None and command.y is not None  # of `initial_state`, and there is a routing
        dt = elapsed(state.time, measurement.time, self.integration_limit, later.q_bar)
        valid = (command.feedback.status != int(FeedbackStatus.INVALID)) & (dt > 0)
        seen = self._seen(ahead, self._pieces(later, state.pi_hat), target.x_d - command.e, dt)
        seen = Ahead(*(_where(valid, *pair) for pair in zip(seen, ahead, strict=True)))
        none = torch.zeros_like(ahead.next)
        # The next period is as long as this one, so fast the command moves in it.
        ydot = (command.y - ahead.y) / dt.clamp(min=1e-3).unsqueeze(-1)
        ahead = seen._replace(age=ahead.age + dt, status=ahead.next, next=none, y=command.y, ydot=ydot)
        return later._replace(ahead=ahead), command

    def look_ahead(self, state: ControllerState, target: Target, run: Step | None = None) -> ControllerState:
        """The state with a departure from Eq. (16) for its next step.

        Args:
            state: From `forward`.
            target: That it aimed at.
            run: From `rollouts`; None to roll out eagerly.
        """
        ahead, look = state.ahead, self.lookahead
        assert ahead is not None  # of `initial_state`
        zero = torch.zeros_like(ahead.age)
        chain = look.loop.placed(ahead.q)
        off, J = ahead.x - chain.tip, chain.tip_jacobian()
        z = torch.zeros_like(off) if state.integral is None else state.integral
        x_d, xdot_d = (each.expand_as(off) for each in (target.x_d, target.xdot_d))
        # Once a look: the model's lengths do not change over the horizon.
        lengths = self.driven_lengths(state.pi_hat).expand_as(state.pi_hat)
        assert self.routing is not None  # refused otherwise
        B_hat = self.backbone.tendon_matrix(self.routing, lengths)
        if self.shape is None:
            apart = state.q_bar - look.loop.sections(ahead.q)
        else:
            apart = self.backbone.coordinates.on_elongations(look.loop.lengths - lengths)
        edot = xdot_d - (J @ ahead.rate.unsqueeze(-1)).squeeze(-1)
        now = Predicted(ahead.q, ahead.rate, state.q_d, ahead.y, x_d - ahead.x, edot, zero, zero)
        outlook = Outlook(x_d, xdot_d, z, off, apart, B_hat, ahead.payload, ahead.d)
        way = look(now, outlook, look.shifted(ahead.knots, ahead.age), ahead.number, run)
        return state._replace(ahead=ahead._replace(knots=way.knots, age=zero, next=way.status, number=ahead.number + 1))

    def rollouts(self, compile: str, rows: int = 1) -> Step:
        """The steps of `look_ahead`'s model for so many rows, run as `native.compiled` says."""
        look = self.lookahead
        return compiled(look.loop, look.loop.blank(look.knots), compile, rows * look.samples, carries=True)

    def _solve(self, asked: Asked) -> tuple[Tensor, Tensor | None]:
        """qdot (..., n) of Eq. (16) with the departure that waits, and no `Command.limits` of its own."""
        ahead, e = asked.state.ahead, asked.e
        assert ahead is not None  # of `initial_state`
        # As a number: torch.compile does not compare tensors with an enumeration.
        waits = ahead.next == int(AheadStatus.FOLLOWED)
        departure = self.lookahead.loop.departure(ahead.knots, ahead.age + asked.dt)
        departure = torch.where(waits.unsqueeze(-1), departure, 0.0)
        wanted = asked.target.xdot_d.expand_as(e) + departure[..., :3]
        J = asked.chain.tip_jacobian()
        return self.inverse_kinematics(J, e, wanted, asked.q, asked.dt, asked.bounds, departure[..., 3:]), None

    def _pieces(self, state: ControllerState, pi_hat: Tensor) -> Tensor:
        """q (..., n_f) of the arm's pieces, of a q_bar over rest lengths pi_hat (..., n_b), m, or of a shape.

        The arm's own sections have what q_bar says of their material, by algorithm 1: the model's may begin elsewhere.
        """
        loop = self.lookahead.loop
        if self.shape is not None and state.shape is not None:
            return self.shape.shape.configuration(state.shape.shape)
        ends = loop.lengths.cumsum(-1)
        before = section_fractions(*decouple(ends, pi_hat), self.backbone.n_sections)
        shares = before.diff(dim=-2, prepend=torch.zeros_like(before[..., :1, :]))
        q = (shares @ state.q_bar.unflatten(-1, (-1, 3))).flatten(-2)
        # Where the model ends before the arm, its tip is the arm's: what is missing is elongation.
        short = (pi_hat.sum(-1, keepdim=True) - ends[..., -1:]).clamp(max=0.0)
        return loop.spread(torch.cat((q[..., :-1], q[..., -1:] + short), dim=-1))

    def _seen(self, ahead: Ahead, q: Tensor, x: Tensor, dt: Tensor) -> Ahead:
        """`ahead` with what an arm at q (..., n_f), its tip at x (..., 3), tells after dt (...) s.

        The equation of motion holds in the mean over the period. Beside the tendons' friction a period's lag would be
        newtons, so every term is taken as it was on the way: none of a filter's velocity, and the mean of the forces.
        """
        loop, step = self.lookahead.loop, dt.clamp(min=1e-9).unsqueeze(-1)
        arm, known = loop.dynamics, ahead.known.unsqueeze(-1)
        moved = torch.where(known > 0, (q - ahead.q) / step, 0.0)
        swung = torch.where(known > 1, (moved - ahead.moved) / step, 0.0)
        u = loop.K_P * (ahead.y - loop.tendons(q)) + loop.K_D * ahead.ydot
        pull = 0.5 * (ahead.u + u) - (loop.tendon_damping + loop.K_D) * loop.tendons(moved)
        one = torch.ones_like(dt)
        (M, bias), (K, D) = arm.equation(q, moved), arm.diagonals
        M_1, bias_1 = arm.equation(q, moved, one)
        known_forces = (loop.B @ pull.unsqueeze(-1)).squeeze(-1) - bias - K * q - D * moved
        left = (M @ swung.unsqueeze(-1)).squeeze(-1) - known_forces
        of_a_kg = bias - bias_1 - ((M_1 - M) @ swung.unsqueeze(-1)).squeeze(-1)
        # A filter on both keeps the mass what it is, and takes the noise of two differences in a row.
        share = torch.where(known > 1, 1.0 - torch.exp(-self.observer_gain * step), 0.0)
        r, w = torch.lerp(ahead.r, left, share), torch.lerp(ahead.w, of_a_kg, share)
        told, fading = (known > 1).to(dt).squeeze(-1) * dt, torch.exp(-dt / self.payload_time)
        weighed = fading * ahead.weighed + told * (w * w / K).sum(-1)
        explained = fading * ahead.explained + told * (w * r / K).sum(-1)
        payload = (explained / (weighed + PRIOR)).clamp(0.0, self.payload_limit)
        unexplained = r - payload.unsqueeze(-1) * w
        d = torch.lerp(ahead.d, unexplained, torch.where(known > 1, 1.0 - torch.exp(-step / self.force_time), 0.0))
        rate = torch.lerp(ahead.rate, moved, 1.0 - torch.exp(-step / self.rate_time))
        count = (ahead.known + 1).clamp(max=2)
        return ahead._replace(
            q=q, moved=moved, rate=rate, x=x, u=u, r=r, w=w, weighed=weighed, explained=explained, d=d, payload=payload,
            known=count,
        )  # fmt: skip


def _where(rows: Tensor, value: Tensor, other: Tensor) -> Tensor:
    """A value where rows (...) are good and it is finite, another elsewhere."""
    whole = rows[(..., *(None,) * (value.dim() - rows.dim()))] & torch.isfinite(value)
    return torch.where(whole, value, other)
