"""The action mode that tunes: the A-PCC controller drives the arm, the action sets its adaptation gains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from apcc_torch.control.adaptation import AdaptiveLaw, AdaptiveLawSettings, NormalisedLawSettings
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_refusal import LookaheadRefusal
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.envs.actions import ActionSettings
from apcc_torch.envs.backbone_points import Positions
from apcc_torch.envs.places import middles_and_ends, places, sensors_of
from apcc_torch.errors import ConfigError
from apcc_torch.model.abscissae import decouple, section_fractions
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.native.compiled import Step
from apcc_torch.part import Part, part_of
from apcc_torch.settings import OURS, resolved, setting
from apcc_torch.spread import ALONG

DYNAMICS = ("kinematic", "dynamic")

CONTROL: Mapping[str, Any] = {
    "adaptation": NormalisedLawSettings(gamma=[ALONG, 9.0, 4.25, 3.5]),  # Eq. (15), a decade up section V-A's gains
    "mode": "position",  # the sensors tell no orientations
    "velocity": "commanded",
    "window": 3,  # of a filter that nothing reads then
    "order": 1,
    "bounds": {"lower": 0.6, "upper": 1.4, "reach": "last"},
}
"""How the controller of an environment differs from the shipped one."""

BY_DYNAMICS: Mapping[str, Mapping[str, Any]] = {"kinematic": {"K": 1.0, "null_gain": 1.0}, "dynamic": {"K": 1.8}}
"""K as in sections V-A and V-B."""


@dataclass(frozen=True, kw_only=True)
class AdaptiveLoopSettings(ActionSettings):
    """Settings of `AdaptiveLoop`, and what moves: the kinematic or the dynamic arm."""

    dynamics: str = setting(
        "kinematic", "", OURS, "kinematic, the arm follows q_d exactly; dynamic, section V-B's plant", choices=DYNAMICS
    )
    control: Mapping[str, Any] | ControlSettings = setting(
        factory=dict,
        unit="",
        source=OURS,
        meaning="adaptation: what differs on the controller, by name as for `APCCController.for_arm`, or all of it",
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError where the controller cannot be."""
        super().check()
        control = self.control_settings()
        if self.dynamics == "kinematic" and part_of(control.model) is not PCCBackbone:
            raise ConfigError("model must be PCCBackbone where the arm is kinematic: it follows q_d itself")
        if self.action == "pressures" and self.dynamics == "kinematic":
            raise ConfigError("action='pressures' needs dynamics='dynamic': a kinematic arm has no mass to be pushed")
        if self.action == "adaptation" and not isinstance(control.adaptation, AdaptiveLawSettings):
            raise ConfigError("adaptation must be an AdaptiveLaw: the action sets its gamma")
        if control.feedback.mode != "position":
            raise ConfigError("feedback.mode must be position: an environment's sensors tell no orientations")
        if control.lookahead is not None:
            LookaheadRefusal.NO_CONTROLLER.check(self.action != "adaptation")
            LookaheadRefusal.KINEMATIC.check(self.dynamics == "kinematic")

    def control_settings(self) -> ControlSettings:
        """The controller's settings."""
        bounds = {"bend_bound": self.bend_bound, "elongation_bound": self.elongation_bound}
        if isinstance(self.control, ControlSettings):
            return resolved(ControlSettings, (self.control,), {}).with_keys(bounds)
        shipped = ControlSettings().with_keys({**CONTROL, **BY_DYNAMICS[self.dynamics]})
        return shipped.with_keys({**bounds, **self.control})


class _Looks(Part):
    """A look ahead as a module, so that `functional_call` can give each row its own racks."""

    def __init__(self, controller: LookaheadController) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, state: ControllerState, target: Target, run: Step | None) -> ControllerState:
        return self.controller.look_ahead(state, target, run)


class AdaptiveLoop(Part):
    """The controller in the loop, with gains that each row sets anew at every step.

    Algorithm 2 fits the sensors' positions, Eq. (32); the law is Eq. (15) as it ships. Where the sensors and racks of a
    row's arm lie along it is known to the controller, as in the paper; how long its sections are is not.

    Args:
        arm: The arm.
        like: Dtype and device.
        *settings, **changes: See `AdaptiveLoopSettings`.

    Attributes:
        looks: Whether the controller looks ahead.
    """

    settings_type = AdaptiveLoopSettings

    gamma: Tensor
    nominal: Tensor
    axis: Tensor
    between: Tensor
    decades: float

    def __init__(self, arm: Arm, like: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(AdaptiveLoopSettings, settings, changes)
        self.hold(s)
        n_b, lengths = arm.n_sections, arm.rest_lengths()
        sensors, routing, base = sensors_of(arm), arm.routing(), arm.base_rotation().to(like)
        seen_arm = arm.changed(sensors=sensors.on(lengths), true_sensors=None)
        control = s.control_settings().with_keys({"elongation_bound": s.elongation(arm)})
        self.looks = control.lookahead is not None
        self.controller = (LookaheadController if self.looks else APCCController).on(seen_arm, control).to(like)
        self.routed = s.dynamics == "dynamic"
        if not self.routed:
            self.controller.routing = None
        self.register_buffer("nominal", lengths.to(like))
        law = self.controller.laws[0]
        assert isinstance(law, AdaptiveLaw)  # see `AdaptiveLoopSettings.check`
        self.register_buffer("gamma", law.gamma.diagonal(dim1=-2, dim2=-1))
        self.sensors, self.backbone = sensors.to(like), middles_and_ends(n_b).to(like)
        self.racks, self.starts = (places(ends, lengths).to(like) for ends in (routing.anchors, routing.starts))
        # At rest the arm is straight along its base's axis.
        self.register_buffer("axis", base[:, 2])
        before = section_fractions(self.sensors.share, self.sensors.section, n_b)
        self.register_buffer("between", before.diff(dim=0, prepend=torch.zeros_like(before[:1])))

    def initial(self, seen: Tensor, lengths: Tensor, estimate: Tensor) -> ControllerState:
        """The state on arms that are straight and still.

        Args:
            seen: (N, k, 3) sensor positions, m.
            lengths: (N, n_b) the sections' true lengths over the nominal ones.
            estimate: (N, n_b) first estimates over the true lengths.
        """
        pi_hat = self.nominal * lengths * estimate
        # What the distance between two sensors exceeds the model's by is shared by the sections between them.
        apart = (seen * self.axis).sum(-1).diff(dim=-1, prepend=torch.zeros_like(seen[..., :1, 0]))
        parts = self.between * pi_hat.unsqueeze(-2)
        whole = parts.sum(-1)
        stretch = ((apart - whole).unsqueeze(-1) * (parts / whole.clamp(min=1e-9).unsqueeze(-1))).sum(-2)
        q = self.controller.backbone.coordinates.on_elongations(stretch)
        state = self.controller.initial_state(q, pi_hat)._replace(q_d=torch.zeros_like(q))
        if state.ahead is not None:
            state = state._replace(ahead=state.ahead._replace(y=torch.zeros_like(state.ahead.y)))
        return state

    def forward(
        self, state: ControllerState, action: Tensor, seen: Tensor, time: Tensor, target: Target, lengths: Tensor
    ) -> tuple[ControllerState, Command]:
        """One step of the controller.

        Args:
            state: From `initial` or the last step.
            action: (N, n_b) in [-1, 1]: Gamma is the law's times 10^(decades action).
            seen: (N, k, 3) sensor positions, m.
            time: (N,) s.
            target: Where the tip should be.
            lengths: (N, n_b) the sections' true lengths over the nominal ones, which place sensors and racks.
        """
        true = self.nominal * lengths
        X = self.sensors.on(true)
        gains = {
            "laws.0.gamma": torch.diag_embed(self.gamma * torch.pow(10.0, self.decades * action)),
            "bounds.ends": torch.nn.functional.pad(X[..., -1:], (true.shape[-1] - 1, 0)),
            "feedback.abscissae": X,
        }
        if self.routed:
            gains |= self._racks(true, "routing")
        upright = torch.eye(4, dtype=seen.dtype, device=seen.device)[:, :3].expand(*seen.shape[:-1], 4, 3)
        place = torch.nn.functional.pad(seen, (0, 1), value=1.0)
        T = torch.cat((upright, place.unsqueeze(-1)), dim=-1)  # orientations are not used
        arguments = (state, Measurement(T, time), target)
        later: tuple[ControllerState, Command] = functional_call(self.controller, gains, arguments)
        return later

    def look_ahead(
        self, state: ControllerState, target: Target, lengths: Tensor, run: Step | None = None
    ) -> ControllerState:
        """The state with a departure from Eq. (16) for its next step; see `LookaheadController.look_ahead`.

        What is rolled out is the nominal arm, with q_d mapped to the tendons as the controller maps it.

        Args:
            state: From `forward`, where the controller looks ahead.
            target: That it aimed at.
            lengths: (N, n_b) the sections' true lengths over the nominal ones, which place the racks.
            run: From `rollouts`; None to roll out eagerly.
        """
        assert isinstance(self.controller, LookaheadController)  # see `looks`
        racks = self._racks(self.nominal * lengths, "controller.routing")
        later: ControllerState = functional_call(_Looks(self.controller), racks, (state, target, run))
        return later

    def rollouts(self, compile: str, rows: int) -> Step:
        """See `LookaheadController.rollouts`; of a controller that looks ahead."""
        assert isinstance(self.controller, LookaheadController)  # see `looks`
        return self.controller.rollouts(compile, rows)

    def _racks(self, true: Tensor, owner: str) -> dict[str, Tensor]:
        """Where the tendons of arms with lengths (N, n_b), m, end and begin, as tensors of a routing's owner."""
        return {f"{owner}.anchors": self.racks.on(true), f"{owner}.starts": self.starts.on(true)}

    def model_points(self, state: ControllerState, lengths: Tensor) -> Positions:
        """Where the virtual model has the middles and ends of the true sections, and the sensors, by algorithm 1.

        Args:
            state: The controller's.
            lengths: (N, n_b) the sections' true lengths over the nominal ones.
        """
        true = self.nominal * lengths
        X = torch.cat((self.backbone.on(true), self.sensors.on(true)), dim=-1)
        T = self.controller.backbone.pose(state.q_bar, state.pi_hat, *decouple(X, state.pi_hat))
        return Positions(*T[..., :3, 3].split((len(self.backbone.share), len(self.sensors.share)), dim=-2))
