"""Settings of a run in real time to its parts."""

from __future__ import annotations

import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.realtime import RealtimeSettings, limits_of
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.hardware.control import Control, blank_step
from apcc_torch.hardware.devices import Devices, devices
from apcc_torch.hardware.dry_run import DryRunActuator
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.log_format import Layouts, layouts
from apcc_torch.hardware.looking_ahead import LookingAhead
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.ramp import Ramp, RampControl
from apcc_torch.hardware.sensing import Sensing, blank_frame
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.native.compiled import compiled
from apcc_torch.reading import keyed
from apcc_torch.settings import check_choice

EXPERIMENTS = ("dynamic", "tendons")


class RealtimeBuilder:
    """Builds the parts of one run.

    Raises:
        ConfigError: A setting has no meaning.
    """

    def __init__(self, settings: RealtimeSettings) -> None:
        arm = settings.arm
        if arm.sensor_kinds() is not None or arm.curvature_sensors is not None:
            raise ConfigError(
                "arm.sensed and arm.curvature_sensors must be null here: the loop on an arm reads poses alone; "
                "mixed sensors run in a simulation, or through APCCController"
            )
        self.settings = settings
        self.model = Builder(settings)

    def devices(self) -> Devices:
        """The devices of the settings, not yet connected."""
        real = devices(self.settings.hardware, self.simulated_arm)
        return real._replace(actuator=DryRunActuator(real.actuator)) if self.settings.dry_run else real

    def simulated_arm(self, step: float) -> SimulatedArm:
        """The true arm of a simulated run, stepped by `step`, s."""
        s, plant = self.settings, self.model.plant(self.payload())
        sensors, abscissae = self.model.pose_sensors(), self.model.true_sensors_at()
        return SimulatedArm(plant, sensors, abscissae, step, s.plant.settle, s.seed, s.compile)

    def payload(self) -> torch.Tensor:
        """(1,) the payload, kg.

        Raises:
            ConfigError: There is not exactly one.
        """
        payloads = self.model.payloads()
        if payloads.shape[0] != 1:
            raise ConfigError(f"experiment.payloads must hold one payload on one arm, got {payloads.tolist()}")
        return payloads

    def trajectory(self) -> SetPoint | SineTrajectory:
        """Where the end effector is to go.

        Raises:
            ConfigError: It is no experiment on the arm, or there is not exactly one set-point, nor a sine.
        """
        if not self.settings.experiment.setpoints:
            return self.model.sine()
        points = self.model.setpoints()
        if points.shape[0] != 1:
            raise ConfigError(f"experiment.setpoints must hold one point on one arm, got {points.shape[0]}")
        return SetPoint(points[0])

    def control(self) -> Control:
        """The controller on its trajectory, or looking on while the tendons go their own way."""
        pi_hat, way = self.model.first_estimate(), self.way()
        controller = self.model.controller(adaptive=False if isinstance(way, Ramp) else None)
        step = compiled(controller, blank_step(controller, pi_hat), self.settings.compile)
        if isinstance(way, Ramp):
            return RampControl(controller, pi_hat, way, step)
        targets = compiled(way, (torch.zeros((), dtype=pi_hat.dtype),), self.settings.compile)
        looking = None
        if isinstance(controller, LookaheadController):
            looking = LookingAhead(controller, controller.rollouts(self.settings.compile))
        return Control(controller, way, pi_hat, step, targets, looking)

    def way(self) -> Ramp | SetPoint | SineTrajectory:
        """Where the tendons go in an experiment of kind `tendons`, else where the end effector is to go."""
        kind = check_choice("experiment.kind", self.settings.experiment.kind, EXPERIMENTS)
        return self.ramp() if kind == "tendons" else self.trajectory()

    def ramp(self) -> Ramp:
        """Where the tendons go in an experiment of kind `tendons`."""
        with keyed("ramp"):
            return Ramp(self.model.routing().n_tendons, self.settings.ramp)

    def layouts(self) -> Layouts:
        """The messages of the run's log."""
        routing, build = self.model.routing(), self.model
        sizes = build.backbone().n, build.n_sections, build.sensors_at().shape[0], routing.n_tendons
        ahead = self.settings.lookahead is not None
        return layouts(*sizes, pressures=build.arm.chambers is not None, ahead=ahead)

    def limits(self) -> CommandLimits:
        """The clamps of every command."""
        return limits_of(self.model.arm, self.settings.guards)

    def sensing(self, mounts: Mounts | None = None) -> Sensing:
        """What judges frames, of bodies that sit on the arm as `mounts` says."""
        settings = self.settings.guards.sensing
        with keyed("guards.sensing.gate"):
            gate = SensorGate(self.model.sensors_at(), settings.gate)
        judge = compiled(gate, blank_frame(gate), self.settings.compile)
        return Sensing(gate, self.model.base_rotation(), settings, mounts, judge)

    def guards(self) -> GuardSettings:
        """What ends the run. Only a set-point can be arrived at."""
        e, guards = self.settings.experiment, self.settings.guards
        return guards if e.kind == "dynamic" and e.setpoints else guards.changed(arrival_error=None)
