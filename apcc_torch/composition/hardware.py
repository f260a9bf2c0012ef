"""What can be set of the devices of a run in real time. Values and meanings stand in conf/hardware."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass
class SimulatedConfig:
    """The simulated arm's devices."""

    lockstep: bool = False
    step: float = 5e-3
    frame_rate: float = 50.0
    frame_latency: float = 8e-3
    motor_speed: float = 0.3
    resolution: float = 1.5e-5


@dataclass
class GripperConfig:
    """The gripper's motor; without an id there is none."""

    id: int | None = None
    open_angle: float = 1.0
    closed_angle: float = 2.0
    current_limit: float = 0.3
    tolerance: float = 0.1


@dataclass
class DynamixelConfig:
    """The tendons' motors. `Any`: a number, or one a tendon."""

    port: str = MISSING
    ids: list[int] = MISSING
    spool_radii: Any = MISSING
    signs: Any = MISSING
    lower: Any = MISSING
    upper: Any = MISSING
    baud: int = 1_000_000
    mode: str = "current_based_position"
    current_limit: float = 1.0
    profile_velocity: float = 4.0
    profile_acceleration: float = 40.0
    bus_watchdog: float = 0.1
    reply_timeout: float = 0.01
    torque_constant: float = 1.3
    zero_tolerance: float = 2e-3
    model_number: int = 1030
    minimum_firmware: int = 38
    release_torqued: bool = False
    gripper: GripperConfig = field(default_factory=GripperConfig)


@dataclass
class OptiTrackConfig:
    """The motion capture."""

    base: str = MISSING
    bodies: list[str] = MISSING
    server: str = "127.0.0.1"
    interface: str = "127.0.0.1"
    multicast: bool = False
    group: str = "239.255.42.99"
    command_port: int = 1510
    data_port: int = 1511
    up: str = "z"
    scale: float = 1.0
    base_offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0205])
    base_quaternion: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0, 1.0])
    static_base: bool = True
    base_frames: int = 25
    base_position_tolerance: float = 3e-3
    base_angle_tolerance: float = 0.03
    max_age: float = 0.06
    timeout: float = 0.5
    connect_timeout: float = 3.0
    keepalive: float = 0.5
    max_speed: float = 1.0
    position_margin: float = 0.01
    max_angular_rate: float = 8.0
    angle_margin: float = 0.15
    recovery_frames: int = 5
    frozen_frames: int = 25
    swap_radius: float = 0.03
    quaternion_tolerance: float = 2e-3
    max_drift: float = 1e-4
    clock_step: float = 0.1
    latency: float = 0.0


@dataclass
class CalibrationConfig:
    """What a calibration measures, and what a run confirms of it."""

    file: str | None = None
    id: str | None = None
    lengths: bool = True
    length_tolerance: float = 0.02
    rest_tolerance: float | None = 0.02
    base_tolerance: float = 5e-3
    base_angle_tolerance: float = 0.03
    frames: int = 50
    timeout: float = 10.0
    scatter: float = 2e-3
    check_signs: bool = False
    pull: float = 5e-3


@dataclass
class HardwareConfig:
    """Which devices."""

    kind: str = MISSING
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    dynamixel: DynamixelConfig | None = None
    optitrack: OptiTrackConfig | None = None
