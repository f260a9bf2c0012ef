"""The action mode that tunes: the A-PCC controller drives the arm, the action sets its adaptation gains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.envs.actions import ActionSettings
from apcc_torch.envs.backbone_points import Positions
from apcc_torch.envs.places import middles_and_ends, places, sensors_of
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple, section_fractions
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part
from apcc_torch.settings import OURS, PAPER, Numbers, resolved, setting, spread

DYNAMICS = ("kinematic", "dynamic")


@dataclass(frozen=True, kw_only=True)
class AdaptiveLoopSettings(ActionSettings):
    """Settings of `AdaptiveLoop`, and what moves: the kinematic or the dynamic arm."""

    dynamics: str = setting(
        "kinematic", "", OURS, "kinematic, the arm follows q_d exactly; dynamic, section V-B's plant", choices=DYNAMICS
    )
    model: type[KinematicModel] = setting(PCCBackbone, "", OURS, "class of the controller's kinematic model")
    gamma: Numbers = setting(
        unit="",
        source=OURS,
        meaning="adaptation gains of a zero action; a decade up they are section V-A's",
        factory=lambda: {"along": [9.0, 4.25, 3.5]},
        rows="sections",
        above=0,
    )
    task_gain: float | None = setting(
        None, "1/s", PAPER, "K of Eq. (16); null: 1.0 of section V-A for kinematic arms, 1.8 of V-B else", above=0
    )
    null_gain: float | None = setting(
        None, "m/s", OURS, "weight of the elongation cost Psi; null: 1.0 for kinematic arms, 0.2 else", least=0
    )
    lower: float = setting(0.6, "", OURS, "least rest lengths over the nominal ones", above=0)
    upper: float = setting(1.4, "", OURS, "largest rest lengths over the nominal ones", above=0)
    normalisation: float = setting(10.0, "s^2", OURS, "nu of the law's 1 + nu ||Y||^2", least=0)
    dead_zone: float = setting(6e-4, "m", OURS, "position error below which the law rests", least=0)

    def check(self) -> None:
        """Raises ConfigError where the kinematic arm is to have another model: it follows q_d itself."""
        super().check()
        if self.dynamics == "kinematic" and self.model is not PCCBackbone:
            raise ConfigError("model must be PCCBackbone where the arm is kinematic: it follows q_d itself")

    def task_gains(self) -> tuple[float, float]:
        """K and the weight of Psi."""
        K, null_gain = {"kinematic": (1.0, 1.0), "dynamic": (1.8, 0.2)}[self.dynamics]
        return K if self.task_gain is None else self.task_gain, null_gain if self.null_gain is None else self.null_gain


class AdaptiveLoop(Part):
    """The controller in the loop, with gains that each row sets anew at every step.

    Algorithm 2 fits the sensors' positions, Eq. (32); the law is Eq. (15) with the estimator-aware regressor. Where the
    sensors and racks of a row's arm lie along it is known to the controller, as in the paper; how long its sections are
    is not.

    Args:
        arm: The arm.
        like: Dtype and device.
        *settings, **changes: See `AdaptiveLoopSettings`.
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
        n_b, nominal, base = arm.n_sections, arm.rest_lengths().to(like), arm.base_rotation().to(like)
        s = s.changed(gamma=spread("gamma", s.gamma, n_b).to(like))
        self.hold(s)
        self.register_buffer("nominal", nominal)
        self.sensors = sensors_of(arm).to(like)
        self.backbone = middles_and_ends(n_b).to(like)
        routing = arm.routing()
        self.racks, self.starts = (
            places(ends, arm.rest_lengths()).to(like) for ends in (routing.anchors, routing.starts)
        )
        K, null_gain = s.task_gains()
        model = s.model(n_b, base_rotation=base)  # type: ignore[call-arg]
        X = self.sensors.on(nominal)
        law = AdaptiveLaw(
            n_b,
            self.gamma,
            lower=s.lower * nominal,
            upper=s.upper * nominal,
            normalisation=s.normalisation,
            dead_zone=s.dead_zone,
            reach=torch.nn.functional.pad(X[-1:], (n_b - 1, 0)),
        )
        self.routed = s.dynamics == "dynamic"
        self.controller = APCCController(
            model,
            StateFeedback(model, X, mode="position"),
            SavitzkyGolay(3, 1),  # the commanded velocity is used
            InverseKinematics(K, null_gain=null_gain, coordinates=model.coordinates).to(like),
            law,
            routing=routing.to(like) if self.routed else None,
            velocity="commanded",
            bend_bound=s.bend_bound,
            elongation_bound=s.elongation(arm),
        )
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
        return self.controller.initial_state(q, pi_hat)._replace(q_d=torch.zeros_like(q))

    def forward(
        self, state: ControllerState, action: Tensor, seen: Tensor, time: Tensor, target: Target, lengths: Tensor
    ) -> tuple[ControllerState, Command]:
        """One step of the controller.

        Args:
            state: From `initial` or the last step.
            action: (N, n_b) in [-1, 1]: Gamma is `gamma` times 10^(decades action).
            seen: (N, k, 3) sensor positions, m.
            time: (N,) s.
            target: Where the tip should be.
            lengths: (N, n_b) the sections' true lengths over the nominal ones, which place sensors and racks.
        """
        true = self.nominal * lengths
        X = self.sensors.on(true)
        gains = {
            "law.gamma": torch.diag_embed(self.gamma * 10.0 ** (self.decades * action)),
            "law.reach": torch.nn.functional.pad(X[..., -1:], (true.shape[-1] - 1, 0)),
            "feedback.abscissae": X,
        }
        if self.routed:
            gains["routing.anchors"] = self.racks.on(true).unsqueeze(-2)
            gains["routing.starts"] = self.starts.on(true).unsqueeze(-2)
        upright = torch.eye(4, dtype=seen.dtype, device=seen.device)[:, :3].expand(*seen.shape[:-1], 4, 3)
        place = torch.nn.functional.pad(seen, (0, 1), value=1.0)
        T = torch.cat((upright, place.unsqueeze(-1)), dim=-1)  # orientations are not used
        arguments = (state, Measurement(T, time), target)
        later: tuple[ControllerState, Command] = functional_call(self.controller, gains, arguments)
        return later

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
