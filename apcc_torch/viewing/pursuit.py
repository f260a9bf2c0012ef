"""A simulated arm under its controller that pursues a target, step by step: the closed loop of `simulate`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import with_dynamics
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.composite_controller import CompositeController, CompositeState
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import ControllerState
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.native.compiled import compiled
from apcc_torch.simulation.dynamic import ClosedLoop, LoopState
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import Outline


class Pursuit:
    """One arm in its closed loop.

    Target and payload may be set at any time, by any thread; the next step has them.

    Args:
        settings: Of a run: arm, controller, plant, sensors, `compile`. Its first set-point and payload are the first.

    Attributes:
        time: s. error: m, between the true tip and the target. diverged: Whether the true arm left all bounds.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """

    def __init__(self, settings: SimulateSettings) -> None:
        build = Builder(settings)
        self.arm = build.arm
        self.period = 1.0 / settings.controller.rate
        self.noise = settings.sensors
        self.first_estimate = build.first_estimate()
        self.plant = build.plant(build.payloads()[:1].clone())
        self.set_point = SetPoint(build.setpoints()[:1].clone())
        self.generator = torch.Generator(build.device).manual_seed(settings.seed)
        controller = with_dynamics(build, build.controller())
        sensors, places = build.pose_sensors(), build.true_sensors_at()
        bent = build.curvature_places()
        self.loop = ClosedLoop(self.plant, controller, sensors, self.set_point, self.period, places, bent)
        self.controller: APCCController = (
            controller.kinematic if isinstance(controller, CompositeController) else controller
        )
        with torch.inference_mode():
            self.step_loop = compiled(self.loop, self.loop.blank(), settings.compile, 1)
            self.rollouts = self.loop.rollouts(settings.compile)
            self.rest = self.plant.settled(self.plant.settle, self.period / self.plant.substeps, settings.compile)
        self.true = Outline(self.plant.backbone, self.arm.n_sections, self.plant.routing)
        self.model = Outline(self.controller.backbone, self.controller.backbone.n_sections)
        self.reset()

    @property
    def target(self) -> Array:
        """(3,) m."""
        target: Array = self.set_point.x_d[0].numpy().copy()
        return target

    @target.setter
    def target(self, x_d: Array) -> None:
        with torch.inference_mode():
            # In place: compiled code reads it where it is.
            self.set_point.x_d.copy_(torch.as_tensor(np.asarray(x_d)[None]))

    @property
    def payload(self) -> float:
        """kg at the tip."""
        return float(self.plant.payload)

    @payload.setter
    def payload(self, mass: float) -> None:
        with torch.inference_mode():
            self.plant.payload.fill_(mass)

    def reset(self) -> None:
        """Puts the arm back to where it hung when the view began, and the estimates to the first ones."""
        with torch.inference_mode():
            self.now: LoopState = self.loop.start(self.rest, self.first_estimate, self.generator)
            self.steps = 0
            self.zero = torch.zeros((), dtype=self.first_estimate.dtype)
            self.q, self.u = self.now.plant.arm.q, torch.zeros_like(self.now.y)
            self.x = self.plant.backbone.tip(self.q, self.plant.dynamics.lengths)
            self.q_bar, self.lengths = self._state.q_bar, self._state.pi_hat

    def step(self) -> None:
        """One control period."""
        with torch.inference_mode():
            draws = self.loop.draw(self.now.sensors.queue[..., 0, :, :, :], self.generator)
            time, k = self.zero + self.time, torch.tensor(self.steps)
            now, row = self.step_loop(self.now, time, k, draws)
            self.now = self.loop.look_ahead(now, time, self.rollouts)
            # As the loop's log has them: q_bar belongs to the rest lengths before the step.
            self.x, self.q, self.q_bar, self.lengths, self.u = row[1], row[2], row[3], row[5], row[-2]
        self.steps += 1

    @property
    def time(self) -> float:
        """s since the arm began."""
        return self.steps * self.period

    @property
    def error(self) -> float:
        """m, from the true tip to the target."""
        return float((self.set_point.x_d - self.x).norm())

    @property
    def diverged(self) -> bool:
        """Whether the true arm left all bounds."""
        return int(self.now.plant.diverged_at[0]) >= 0

    @property
    def pi_hat(self) -> Array:
        """(n_b,) m, the estimates."""
        pi_hat: Array = self.lengths.expand_as(self._state.pi_hat)[0].numpy()
        return pi_hat

    @property
    def tension(self) -> Array:
        """(n_a,) N."""
        tension: Array = -self.u[0].numpy()
        return tension

    def moment(self) -> Moment:
        """The arm at its last step."""
        with torch.inference_mode():
            sections, tendons = self.true(self.q[0], self.plant.dynamics.lengths)
            T = self.loop.poses(self.q)
            return Moment(
                sections,
                tendons,
                self.tension,
                T[0].numpy(),
                self._covariance(T),
                self.model.centre_line(self.q_bar[0], torch.from_numpy(self.pi_hat)),
                self.target,
            )

    @property
    def _state(self) -> ControllerState:
        state = self.now.controller
        return state.kinematic if isinstance(state, CompositeState) else state

    def _covariance(self, T: Tensor) -> Array | None:
        """(k, 3, 3) m^2, of the sensors' places on the estimated shape; without one, of the sensors' own noise."""
        shape, state = self.controller.shape, self._state.shape
        if shape is None or state is None:
            noise = float(self.noise.position_noise)
            return noise**2 * torch.eye(3).expand(T.shape[-3], 3, 3).numpy() if noise else None
        of, seen = shape.shape, torch.ones(T.shape[:-2], dtype=torch.bool)
        dt = self.zero + self.period
        spread = of.covariance(state.shape, T, seen, seen, self.now.y, dt.expand(T.shape[:-3]))
        places: Array = of.point_covariance(state.shape, spread, of.abscissae)[0].numpy()
        return places
