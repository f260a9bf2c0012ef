"""From lengths to pressures: what chambers need so that the arm takes the lengths that the kinematics asks for.

Chambers set forces, and nothing measures their lengths. So the controller takes them from the poses, and a PID loop on
them adds to the pressures that hold the arm at rest. With c = B^+T y the strains of the sections that lengths y mean,
K the arm's stiffness and G its weight,

    u = B^+ (K c_d + G(c_d) + k (K_P (c_d - c) - K_D cdot)) + z,   zdot = K_I B^+ k (c_d - c),

and the pressures are those that make the forces u. k is K with what weight adds to it where the arm hangs, so gains are
shares of what holds the arm and suit any arm. An arm on air swings as a pendulum: K_D damps that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from apcc_torch.control.bounds import RateBounds
from apcc_torch.model.arm import Arm
from apcc_torch.model.chambers import ChamberForce
from apcc_torch.model.coordinates import Coordinates
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.statics import load_stiffness
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, Setting, Settings, aligned, resolved, setting
from apcc_torch.shapes import check_same, check_tensor

NEGLIGIBLE = 1e-5
"""Strain, rad and m, that is rounding and no limit, in single precision too."""


@dataclass(frozen=True, kw_only=True)
class PressureControlSettings(Settings):
    """Settings of `PressureControl`."""

    K_P: Setting = setting(
        0.1, "", OURS, "force on a strain that is off, over the arm's stiffness", rows="number", least=0
    )
    K_I: Setting = setting(0.5, "1/s", OURS, "how fast that force grows meanwhile, likewise", rows="number", least=0)
    K_D: Setting = setting(0.1, "s", OURS, "force against the strains' rates, likewise", rows="number", least=0)
    rate_time: Setting = setting(0.03, "s", OURS, "over which those rates are averaged", rows="number", above=0)
    feedforward: bool = setting(True, "", OURS, "pressures that hold the arm at rest where it is to be; false: none")
    share: bool = setting(
        True,
        "",
        OURS,
        "where a chamber is at its least pressure, all of its section get more: bends go before elongation",
    )
    bend_rate: Setting = setting(
        2.0,
        "rad/s",
        OURS,
        "bound on the rates of the bends of q_d: no valve follows faster",
        rows="number",
        above=0,
    )
    windup_time: Setting = setting(
        0.1,
        "s",
        OURS,
        "in which what the chambers cannot do leaves the integral and q_d",
        rows="number",
        above=0,
    )


class PressureState(NamedTuple):
    """What the loop remembers.

    z: (..., n_a) its integral, N. y: (..., n_a) the last lengths, m. ydot: (..., n_a) their rates, m/s.
    excess: (..., 3 n_b) strains, rad and m, by which the wanted shape has to change for what the chambers can do.
    """

    z: Tensor
    y: Tensor
    ydot: Tensor
    excess: Tensor


class PressureControl(Part):
    """Pressures of an arm's chambers; see the module's head.

    A chamber can only push, so about no pressure a section only gets longer. What limits leave undone leaves the
    integral, and bounds the velocity of q_d: inverse kinematics then reaches the target by what is not at its limit.

    Args:
        dynamics: The arm as it is believed to be, one piece a section.
        B: (..., 3 n_b, n_a) its actuation matrix.
        chambers: Forces and limits.
        together: (g, n_a) 1 where a chamber is of a group, those of one section; 0 elsewhere.
        *settings, **changes: See `PressureControlSettings`.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> from apcc_torch.model.chambers import Chambers
        >>> arm = Arm(lengths=[0.145, 0.145], mass=0.3, chambers=Chambers(rest_pressure=2e4))
        >>> control = PressureControl.on(arm, PressureControlSettings())
        >>> y = torch.zeros(6).double()
        >>> state, p = control(control.initial_state(y), y, y, torch.tensor(0.01).double())
        >>> bool((p < 2e4).all())  # the weight pulls, so less pressure keeps the lengths
        True
    """

    settings_type = PressureControlSettings
    B: Tensor
    B_pinv: Tensor
    spring: Tensor
    together: Tensor
    K_P: Setting
    K_I: Setting
    K_D: Setting
    rate_time: Setting
    feedforward: bool
    share: bool
    bend_rate: Setting
    windup_time: Setting

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        B: Tensor,
        chambers: ChamberForce,
        together: Tensor,
        *settings: Any,
        **changes: Any,
    ) -> None:
        super().__init__()
        check_tensor("B", B, (dynamics.n, None))
        check_tensor("together", together, (None, B.shape[-1]))
        self.dynamics = dynamics
        self.chambers = chambers
        straight = torch.zeros_like(B[..., 0])
        with B.device:  # where numbers become tensors
            weight = load_stiffness(dynamics, straight)[1].diagonal(dim1=-2, dim2=-1).abs()
        spring = dynamics.stiffness_diagonal + weight.to(B)
        hold_rows(self, B=(B, 2), B_pinv=(torch.linalg.pinv(B), 2), spring=(spring, 1), together=(together, 2))
        self.hold(resolved(PressureControlSettings, settings, changes))

    @classmethod
    def on(cls, arm: Arm, settings: PressureControlSettings) -> Self | None:
        """The loop of an arm; None of one without chambers."""
        if arm.chambers is None:
            return None
        lengths = arm.rest_lengths()
        sections = torch.tensor(arm.chambers.sections(arm.n_sections), device=lengths.device)
        together = (sections == sections.unique().unsqueeze(-1)).to(lengths)
        return cls(
            arm.dynamics(), arm.routing().matrix(lengths), arm.chambers.force(arm.n_sections), together, settings
        )

    def initial_state(self, y: Tensor) -> PressureState:
        """Before the first step, with the chambers' lengths y (..., n_a) m."""
        none = torch.zeros_like(y)
        return PressureState(none, y, none, torch.zeros_like(self.strains(y)))

    def strains(self, y: Tensor) -> Tensor:
        """The sections' strains (..., 3 n_b), rad and m, that come nearest to lengths y (..., n_a), m."""
        return (self.B_pinv.to(y).mT @ y.unsqueeze(-1)).squeeze(-1)

    def forward(self, state: PressureState, y_d: Tensor, y: Tensor | None, dt: Tensor) -> tuple[PressureState, Tensor]:
        """The state after one step, and the pressures (..., n_a), Pa, within their limits.

        Args:
            state: From `initial_state` or the last step.
            y_d: (..., n_a) wanted length changes, m.
            y: (..., n_a) those that the poses say, m; None: as wanted.
            dt: (...) s since the last step.
        """
        check_tensor("y_d", y_d, (self.B.shape[-1],))
        y = check_tensor("y", y_d if y is None else y, (self.B.shape[-1],))
        check_same(y_d=y_d, y=y)
        step = dt.unsqueeze(-1)
        c_d = self.strains(y_d)
        share = step / (step + aligned(self.rate_time, 1))
        ydot = state.ydot + share * ((y - state.y) / step.clamp(min=1e-6) - state.ydot)
        stiffness, spring = self.dynamics.stiffness_diagonal.to(y), self.spring.to(y)
        off, drag = spring * (c_d - self.strains(y)), spring * self.strains(ydot)
        tau = aligned(self.K_P, 1) * off - aligned(self.K_D, 1) * drag
        if self.feedforward:
            tau = tau + self._holding(c_d)
        wish = self._forces(tau) + state.z
        p = self._pressures(wish)
        undone = self.chambers(p) - wish
        share = (step / aligned(self.windup_time, 1)).clamp(max=1.0)
        z = state.z + step * aligned(self.K_I, 1) * self._forces(off) + share * undone
        excess = (self.B.to(y) @ undone.unsqueeze(-1)).squeeze(-1) / stiffness
        finite = torch.isfinite(z).all(-1, keepdim=True)
        later = PressureState(z, y.expand_as(z), ydot, excess)
        return PressureState(*(torch.where(finite, new, old) for new, old in zip(later, state, strict=True))), p

    def bounds(self, state: PressureState, coordinates: Coordinates, others: RateBounds | None = None) -> RateBounds:
        """Bounds of qdot (..., n) that lead q_d to what the chambers can do, and from there no farther.

        Where an elongation is at its limit, bends have to do what it cannot. Near a straight arm they would have to be
        fast for that, and opposed to each other: so no task asks for faster ones, see `eased`.

        Args:
            state: After the last step.
            coordinates: What q_d is made of.
            others: Bounds that hold beside them; None for none.
        """
        told = torch.where(state.excess.abs() > NEGLIGIBLE, state.excess, 0.0) / aligned(self.windup_time, 1)
        x, y, elongation = told.unflatten(-1, (-1, 3)).unbind(-1)
        rate = coordinates.from_bends(x, y) + coordinates.on_elongations(elongation)
        lower, upper = (torch.where(on, rate, bound) for on, bound in ((rate > 0, -torch.inf), (rate < 0, torch.inf)))
        bends = coordinates.from_bends(torch.ones_like(x), torch.ones_like(y)) * aligned(self.bend_rate, 1)
        bends = torch.where(bends > 0.0, bends, torch.inf)
        lower, upper = torch.maximum(lower, -bends), torch.minimum(upper, bends)
        if others is not None:
            lower, upper = torch.maximum(lower, others.lower), torch.minimum(upper, others.upper)
        return RateBounds(torch.minimum(lower, upper), torch.maximum(lower, upper), self.bend_rate)

    def holding(self, y_d: Tensor) -> Tensor:
        """Pressures (..., n_a), Pa, within their limits, that hold the arm at rest with lengths y_d (..., n_a), m."""
        check_tensor("y_d", y_d, (self.B.shape[-1],))
        return self._pressures(self._forces(self._holding(self.strains(y_d))))

    def _holding(self, c: Tensor) -> Tensor:
        """The generalized force (..., 3 n_b) that holds the arm at strains c (..., 3 n_b)."""
        held: Tensor = self.dynamics.stiffness_diagonal.to(c) * c + self.dynamics.static_load(c)
        return held

    def _pressures(self, u: Tensor) -> Tensor:
        """Pressures (..., n_a), Pa, within their limits, for forces u (..., n_a)."""
        return self.chambers.within(self.chambers.pressure(self._shared(u)))

    def _forces(self, tau: Tensor) -> Tensor:
        """The least forces (..., n_a), N, that make a generalized force tau (..., 3 n_b)."""
        return (self.B_pinv.to(tau) @ tau.unsqueeze(-1)).squeeze(-1)

    def _shared(self, u: Tensor) -> Tensor:
        """Forces (..., n_a), raised in every section by what its emptiest chamber lacks."""
        if not self.share or self.chambers.least is None:
            return u
        least = self.chambers(self.chambers.least.to(u))
        lacking = torch.relu(least - u).unsqueeze(-2) * self.together.to(u)
        return u + (lacking.amax(-1, keepdim=True) * self.together.to(u)).sum(-2)
