"""Settings of a run in real time to its parts."""

from __future__ import annotations

import math

import numpy as np
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.build_devices import Devices, real_devices
from apcc_torch.composition.choice import choice
from apcc_torch.composition.realtime import RealtimeConfig, model_settings
from apcc_torch.control.trajectory import SetPoint, Trajectory
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.hardware.clock import Clock, MonotonicClock, VirtualClock
from apcc_torch.hardware.control import Control, blank_step
from apcc_torch.hardware.dry_run import DryRunActuator
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.log_format import Layouts, layouts
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.ramp import Ramp, RampControl
from apcc_torch.hardware.sensing import Sensing, SensingLimits
from apcc_torch.hardware.setup import LoopSettings
from apcc_torch.hardware.simulated.actuator import SimulatedActuator
from apcc_torch.hardware.simulated.arm import SimulatedArm, SimulatedSettings
from apcc_torch.hardware.simulated.process import ProcessWorld
from apcc_torch.hardware.simulated.sensor import SimulatedSensor
from apcc_torch.hardware.simulated.world import LockstepWorld, World
from apcc_torch.hardware.stops import endings
from apcc_torch.native.compiled import compiled

SIMULATED, REAL = KINDS = ("simulated", "dynamixel_optitrack")
EXPERIMENTS = ("dynamic", "tendons")


class RealtimeBuilder:
    """Builds the parts of one run.

    Args:
        config: The resolved settings.

    Raises:
        ConfigError: A setting has no meaning.
    """

    def __init__(self, config: RealtimeConfig) -> None:
        self.config = config
        self.model = Builder(model_settings(config))

    def devices(self) -> Devices:
        """The configured devices, not yet connected."""
        real = choice("hardware.kind", self.config.hardware.kind, KINDS) == REAL
        devices = real_devices(self.config) if real else self._simulated()
        if self.config.dry_run:
            return devices._replace(actuator=DryRunActuator(devices.actuator))
        return devices

    def _simulated(self) -> Devices:
        lockstep = self.config.hardware.simulated.lockstep
        arm = self.simulated_arm()
        clock: Clock
        world: World
        if lockstep:
            clock = virtual = VirtualClock()
            world = LockstepWorld(arm, virtual)
        else:
            clock = MonotonicClock(self.config.loop.spin)
            world = ProcessWorld(arm, clock)
        return Devices(SimulatedActuator(world), SimulatedSensor(world), clock, world.metrics)

    def simulated_arm(self) -> SimulatedArm:
        """The true arm of a simulated run."""
        s, build = self.config.hardware.simulated, self.model
        settings = SimulatedSettings(
            s.step,
            s.frame_rate,
            s.frame_latency,
            s.motor_speed,
            s.resolution,
            self.config.plant.settle,
            self.config.seed,
            self.config.compile,
        )
        routing = build.routing(self.config.plant.layout)
        return SimulatedArm(build.plant(self.payload()), routing, build.pose_sensors(), build.sensors_at(), settings)

    def payload(self) -> torch.Tensor:
        """(1,) the payload, kg.

        Raises:
            ConfigError: There is not exactly one.
        """
        payloads = self.model.payloads()
        if payloads.shape[0] != 1:
            raise ConfigError(f"experiment.payloads must hold one payload on one arm, got {payloads.tolist()}")
        return payloads

    def trajectory(self) -> Trajectory:
        """Where the end effector is to go.

        Raises:
            ConfigError: It is no experiment on the arm, or there is not exactly one set-point, nor a sine.
        """
        choice("experiment.kind", self.config.experiment.kind, EXPERIMENTS)
        if not self.config.experiment.setpoints:
            return self.model.sine()
        points = self.model.setpoints()
        if points.shape[0] != 1:
            raise ConfigError(f"experiment.setpoints must hold one point on one arm, got {points.shape[0]}")
        return SetPoint(points[0])

    def control(self) -> Control:
        """The controller on its trajectory, or looking on while the tendons go their own way."""
        pi_hat = self.model.first_estimate()
        looks_on = choice("experiment.kind", self.config.experiment.kind, EXPERIMENTS) == "tendons"
        controller = self.model.controller(adaptive=False if looks_on else None)
        step = compiled(controller, blank_step(controller, pi_hat), self.config.compile)
        if looks_on:
            return RampControl(controller, pi_hat, self.ramp(), step)
        return Control(controller, self.trajectory(), pi_hat, step)

    def ramp(self) -> Ramp:
        """Where the tendons go in an experiment of kind `tendons`.

        Raises:
            ConfigError: There is no goal, or it has not one entry a tendon.
        """
        ramp = self.config.ramp
        if ramp.goal is None:
            raise ConfigError("ramp.goal must be given for an experiment of kind tendons")
        goal = self.model.vector("ramp.goal", ramp.goal, self.model.routing().n_tendons)
        return Ramp(goal.double().numpy(), ramp.duration)

    def layouts(self) -> Layouts:
        """The messages of the run's log."""
        routing, build = self.model.routing(), self.model
        return layouts(build.backbone().n, build.n_sections, build.sensors_at().shape[0], routing.n_tendons)

    def _tendons(self, key: str, value: object) -> Array:
        n_a = self.model.routing().n_tendons
        return np.array(self.model.gain(f"guards.limits.{key}", value, n_a).expand(n_a).tolist())

    def limits(self) -> CommandLimits:
        """The clamps of every command."""
        limits = self.config.guards.limits
        lower, upper = self._tendons("lower", limits.lower), self._tendons("upper", limits.upper)
        return CommandLimits(lower, upper, self._tendons("rate", limits.rate), self._tendons("step", limits.step))

    def sensing(self, mounts: Mounts | None = None) -> Sensing:
        """What judges frames, of bodies that sit on the arm as `mounts` says."""
        s = self.config.guards.sensing
        abscissae = self.model.sensors_at()
        gate = SensorGate(
            abscissae.shape[0],
            s.max_speed,
            s.position_margin,
            s.max_angular_rate,
            s.angle_margin,
            (s.reach * abscissae).tolist(),
            min(s.max_bend, math.pi),
            s.max_twist,
        )
        limits = SensingLimits(s.max_age, s.stale, s.dropout, s.frozen_frames, s.partial)
        return Sensing(gate, self.model.base_rotation(), limits, mounts)

    def guards(self) -> GuardSettings:
        """What ends the run. Only a set-point can be arrived at."""
        g = self.config.guards
        e = self.config.experiment
        arrival = g.arrival_error if e.kind == "dynamic" and e.setpoints else None
        return GuardSettings(
            self.config.experiment.duration,
            arrival,
            g.arrival_dwell,
            g.max_error,
            g.effort_limit,
            g.effort_dwell,
            g.effort_cap,
            g.slack_effort,
            g.slack_dwell,
            g.range_margin,
            g.overruns,
            g.overrun_window,
            g.failed_exchanges,
            endings(g.endings),
        )

    def loop(self) -> LoopSettings:
        """Rate and preparation."""
        c = self.config.loop
        return LoopSettings(c.rate, c.warm_up, c.fresh_frames, c.fresh_timeout, c.arm_margin, c.hold)
