"""What the OptiTrack sensor is told: addresses, bodies, axes, and the limits of its gates."""

from __future__ import annotations

import ipaddress
import math
from dataclasses import dataclass, fields

from apcc_torch.errors import ConfigError, ValueRangeError

_POSITIVE = (
    *("scale", "max_age", "timeout", "connect_timeout", "keepalive", "max_speed", "max_angular_rate"),
    *("swap_radius", "quaternion_tolerance", "base_position_tolerance", "base_angle_tolerance", "clock_step"),
)
_NOT_NEGATIVE = ("position_margin", "angle_margin", "max_drift", "latency")
_COUNTS = {"base_frames": 1, "recovery_frames": 2, "frozen_frames": 0}  # name -> the least value


@dataclass(frozen=True)
class OptiTrackSettings:
    """Settings of an `OptiTrackSensor`, in SI units.

    Attributes:
        base: Motive's name of the rigid body on the arm's base.
        bodies: Motive's names of the sensors' rigid bodies, from the base to the tip.
        server: IPv4 address of the computer that runs Motive; packets from any other are dropped.
        interface: IPv4 address of this computer on the network of the server; nothing listens elsewhere.
        multicast: Whether Motive streams by multicast; False: unicast.
        group: Multicast group.
        command_port: Motive's command port.
        data_port: Motive's data port; unicast does not use it.
        up: Motive's streamed up axis, "z" or "y"; it is not in the stream. Poses are turned to z up.
        scale: Metres per streamed unit.
        base_offset: Origin of the arm's base frame in the (z-up) frame of the base's rigid body, m.
        base_quaternion: Axes of the arm's base frame in that of the rigid body, unit quaternion x, y, z, w.
        static_base: Whether the base does not move: it is then measured once, and only watched from there on.
        base_frames: Number of frames in which a static base is measured.
        base_position_tolerance: A static base that is this far from where it was measured has been moved, m.
        base_angle_tolerance: The same for its rotation, rad.
        max_age: A sample older than this is not valid, s. Two to three frames are a good choice.
        timeout: The stream has ended when no new frame has come for this long, s.
        connect_timeout: The longest wait for the server's answer, and again for a static base, s.
        keepalive: Interval at which a unicast server is told that we listen, s.
        max_speed: A body's speed limit, m/s: what moves faster has jumped.
        position_margin: What a position may jump at any time, m.
        max_angular_rate: A body's limit of its rotation's rate, rad/s.
        angle_margin: What a rotation may jump at any time, rad.
        recovery_frames: Consistent frames in a row that end a jump, a swap or a restart of the stream.
        frozen_frames: Frames in a row with the very same numbers that make a body frozen; 0: never.
        swap_radius: A body that jumps to within this distance of another's place has taken its identity, m.
        quaternion_tolerance: Limit of how far a quaternion's length is from 1.
        max_drift: Limit of how fast the server's clock and ours drift apart, s/s.
        clock_step: A change of the clocks' difference of more than this is a step, not a delay, s.
        latency: Part of the delay that the stream's stamps cannot show; subtracted from every stamp, s.

    Raises:
        ConfigError: An address, a name or a choice is wrong.
        ValueRangeError: A number is out of its range.
    """

    base: str
    bodies: tuple[str, ...]
    server: str = "127.0.0.1"
    interface: str = "127.0.0.1"
    multicast: bool = False
    group: str = "239.255.42.99"
    command_port: int = 1510
    data_port: int = 1511
    up: str = "z"
    scale: float = 1.0
    base_offset: tuple[float, float, float] = (0.0, 0.0, 0.0205)
    base_quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
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

    def __post_init__(self) -> None:
        for name in ("bodies", "base_offset", "base_quaternion"):  # a configuration file has lists
            object.__setattr__(self, name, tuple(getattr(self, name)))
        self._check_names()
        self._check_addresses()
        self._check_numbers()

    @property
    def names(self) -> tuple[str, ...]:
        """All rigid bodies, the base first."""
        return (self.base, *self.bodies)

    def _check_names(self) -> None:
        if not self.bodies:
            raise ConfigError("bodies must name at least one rigid body")
        if not all(isinstance(name, str) and name for name in self.names):
            raise ConfigError(f"base and bodies must be names, got {self.names}")
        if len(set(self.names)) != len(self.names):
            raise ConfigError(f"base and bodies must all differ, got {self.names}")
        if self.up not in ("y", "z"):
            raise ConfigError(f"up must be 'y' or 'z', got {self.up!r}")

    def _check_addresses(self) -> None:
        for name in ("server", "interface", "group"):
            text = getattr(self, name)
            try:
                address = ipaddress.IPv4Address(text)
            except ValueError as error:
                raise ConfigError(f"{name} must be an IPv4 address, got {text!r}") from error
            if address.is_multicast != (name == "group"):
                raise ConfigError(f"{name} must {'' if name == 'group' else 'not '}be a multicast address, got {text}")
            if address.is_unspecified:
                raise ConfigError(f"{name} must be one address, not {text}, which is all of them")

    def _check_numbers(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if field.name.startswith("base_") and isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise ValueRangeError(f"{field.name} must be finite, got {value}")
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueRangeError(f"{name} must be positive, got {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if not getattr(self, name) >= 0:
                raise ValueRangeError(f"{name} must not be negative, got {getattr(self, name)}")
        for name, least in _COUNTS.items():
            if not getattr(self, name) >= least:
                raise ValueRangeError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name in ("command_port", "data_port"):
            if not 0 < getattr(self, name) < 65536:
                raise ValueRangeError(f"{name} must be from 1 to 65535, got {getattr(self, name)}")
        for name, length in (("base_offset", 3), ("base_quaternion", 4)):
            if len(getattr(self, name)) != length:
                raise ConfigError(f"{name} must have {length} numbers, got {getattr(self, name)}")
        if abs(math.hypot(*self.base_quaternion) - 1.0) > 1e-6:
            raise ValueRangeError(f"base_quaternion must have length 1, got {self.base_quaternion}")
        if self.timeout <= self.max_age:
            raise ValueRangeError(f"timeout must be longer than max_age, got {self.timeout} and {self.max_age}")
