"""The action mode that tunes: the A-PCC controller drives the arm, the action sets its adaptation gains."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.func import functional_call

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.envs.actions import Limits
from apcc_torch.envs.arm import Arm
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple

GAMMA = (9.0, 4.25, 3.5)
"""Adaptation gains Gamma of a zero action; one decade up they are the paper's of section V-A."""

TASK_GAIN = {"kinematic": 1.0, "dynamic": 1.8}
"""K of Eq. (16), 1/s: the paper's of sections V-A and V-B."""


class AdaptiveLoop(nn.Module):
    """The controller in the loop, with gains that each row sets anew at every step.

    Algorithm 2 fits the sensors' positions, Eq. (32); the law is Eq. (15) with the estimator-aware regressor,
    normalised, within 60 to 140 % of the nominal lengths. Where the sensors and racks of a row's arm lie along it is
    known to the controller, as in the paper; how long its sections are is not.

    Args:
        arm: The arm.
        limits: Bounds of q_d, and the range of the gains.
        dynamics: "kinematic" or "dynamic".
        like: Dtype and device.
    """

    gamma: Tensor
    nominal: Tensor

    def __init__(self, arm: Arm, limits: Limits, dynamics: str, like: Tensor) -> None:
        super().__init__()
        n_b = arm.n_sections
        nominal = arm.lengths(like)
        ends = nominal.cumsum(-1)
        backbone = arm.model(n_b, base_rotation=arm.base(like))  # type: ignore[call-arg]
        self.limits = limits
        self.per_rack = arm.tendons_per_rack
        self.routed = dynamics == "dynamic"
        law = AdaptiveLaw(
            n_b,
            like.new_tensor(GAMMA),
            lower=0.6 * nominal,
            upper=1.4 * nominal,
            normalisation=10.0,
            dead_zone=6e-4,
            reach=ends[-1:].expand(n_b) * like.new_tensor((0.0,) * (n_b - 1) + (1.0,)),
        )
        self.controller = APCCController(
            backbone,
            StateFeedback(backbone, ends, mode="position"),
            SavitzkyGolay(3, 1),  # the commanded velocity is used
            InverseKinematics(
                TASK_GAIN[dynamics],
                null_gain=1.0 if dynamics == "kinematic" else 0.2,
                coordinates=backbone.coordinates,
            ).to(like),
            law,
            routing=arm.routing(like) if self.routed else None,
            velocity="commanded",
            bend_bound=limits.bend_bound,
            elongation_bound=limits.elongation_bound,
        )
        self.register_buffer("gamma", like.new_tensor(GAMMA))
        self.register_buffer("nominal", nominal)

    def initial(self, seen: Tensor, lengths: Tensor, estimate: Tensor) -> ControllerState:
        """The state on arms that hang straight and are still.

        Args:
            seen: (N, n_b, 3) sensor positions, m.
            lengths: (N, n_b) the sections' true lengths over the nominal ones.
            estimate: (N, n_b) first estimates over the true lengths.
        """
        pi_hat = self.nominal * lengths * estimate
        # A hanging arm without bends: each section of the model stretches to where its sensor is.
        depth = -seen[..., 2]
        stretch = depth.diff(dim=-1, prepend=torch.zeros_like(depth[..., :1])) - pi_hat
        q = self.controller.backbone.coordinates.on_elongations(stretch)
        return self.controller.initial_state(q, pi_hat)._replace(q_d=torch.zeros_like(q))

    def forward(
        self, state: ControllerState, action: Tensor, seen: Tensor, time: Tensor, target: Target, lengths: Tensor
    ) -> tuple[ControllerState, Command]:
        """One step of the controller.

        Args:
            state: From `initial` or the last step.
            action: (N, n_b) in [-1, 1]: Gamma is `GAMMA` times 10^(decades action).
            seen: (N, n_b, 3) sensor positions, m.
            time: (N,) s.
            target: Where the tip should be.
            lengths: (N, n_b) the sections' true lengths over the nominal ones, which place sensors and racks.
        """
        ends = (self.nominal * lengths).cumsum(-1)
        gains = {
            "law.gamma": torch.diag_embed(self.gamma * 10.0 ** (self.limits.decades * action)),
            "law.reach": torch.nn.functional.pad(ends[..., -1:], (ends.shape[-1] - 1, 0)),
            "feedback.abscissae": ends,
        }
        if self.routed:
            gains["routing.anchors"] = ends.repeat_interleave(self.per_rack, dim=-1)
        upright = torch.eye(4, dtype=seen.dtype, device=seen.device)[:, :3].expand(*seen.shape[:-1], 4, 3)
        place = torch.nn.functional.pad(seen, (0, 1), value=1.0)
        T = torch.cat((upright, place.unsqueeze(-1)), dim=-1)  # orientations are not used
        arguments = (state, Measurement(T, time), target)
        later: tuple[ControllerState, Command] = functional_call(self.controller, gains, arguments)
        return later

    def model_points(self, state: ControllerState, lengths: Tensor) -> Tensor:
        """(N, 6, 3) m: where the virtual model has the middles and ends of the true sections, by algorithm 1.

        Args:
            state: The controller's.
            lengths: (N, n_b) the sections' true lengths over the nominal ones.
        """
        true = self.nominal * lengths
        ends = true.cumsum(-1)
        X = torch.stack((ends - 0.5 * true, ends), dim=-1).flatten(-2)
        T = self.controller.backbone.pose(state.q_bar, state.pi_hat, *decouple(X, state.pi_hat))
        return T[..., :3, 3]
