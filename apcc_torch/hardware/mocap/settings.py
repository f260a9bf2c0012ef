"""What any motion capture is told: bodies, axes, and the limits of its gates."""

from __future__ import annotations

import ipaddress
import math
from dataclasses import dataclass

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_gate import JumpSettings
from apcc_torch.settings import OURS, PAPER, setting

EXACT = 1e-6
"""How far a configured quaternion's length may be from 1."""


@dataclass(frozen=True, kw_only=True)
class MocapSettings(JumpSettings):
    """Settings of a `MocapSensor`, in SI units.

    Raises:
        ConfigError: A name or a choice is wrong.
        ValueRangeError: A number is out of its range.
    """

    base: str = setting("base", "", OURS, "name of the rigid body on the arm's base, as the cameras' program has it")
    bodies: tuple[str, ...] = setting(
        ("disk_1", "disk_3", "disk_5"),
        "",
        PAPER,
        "names of the sensors' rigid bodies, from the base to the tip",
    )
    up: str = setting(
        "z",
        "",
        PAPER,
        "up axis of the stream, which it does not tell; poses are turned to z",
        choices=("y", "z"),
    )
    scale: float = setting(1.0, "m", OURS, "in a streamed unit", above=0)
    base_offset: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0205), "m", PAPER, "the arm's base in the (z-up) frame of the base's rigid body"
    )
    base_quaternion: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 1.0), "", OURS, "axes of the arm's base there, x y z w", least=-1, most=1
    )
    static_base: bool = setting(True, "", OURS, "the base is measured once, when connecting, and only watched then")
    base_frames: int = setting(25, "", OURS, "frames in which a static base is measured", least=1)
    base_position_tolerance: float = setting(
        3e-3, "m", OURS, "from where it was measured; farther, a static base has moved and no pose is valid", above=0
    )
    base_angle_tolerance: float = setting(0.03, "rad", OURS, "the same for its rotation", above=0)
    max_age: float = setting(0.06, "s", OURS, "a sample older than this is not valid; three frames at 50 Hz", above=0)
    timeout: float = setting(0.5, "s", OURS, "without a new frame, after which the stream has ended", above=0)
    connect_timeout: float = setting(
        3.0, "s", OURS, "the longest wait for the server's answer, and again for a static base", above=0
    )
    recovery_frames: int = setting(
        5, "", OURS, "consistent frames in a row that end a jump, a swap or a restart of the stream", least=2
    )
    frozen_frames: int = setting(
        25, "", OURS, "frames in a row with the very same numbers that make a body frozen; 0: never", least=0
    )
    swap_radius: float = setting(
        0.03, "m", OURS, "a body that jumps so near to another's place has taken its identity", above=0
    )
    quaternion_tolerance: float = setting(2e-3, "", OURS, "of a streamed quaternion's length from 1", above=0)
    max_drift: float = setting(1e-4, "s/s", OURS, "between the server's clock and ours", least=0)
    clock_step: float = setting(
        0.1, "s", OURS, "a larger change of the clocks' difference is a step, not a delay", above=0
    )
    latency: float = setting(
        0.0, "s", OURS, "of delay that the stream's stamps do not show; subtracted from every stamp", least=0
    )

    def check(self) -> None:
        """Raises where names or numbers do not fit each other."""
        if not self.bodies:
            raise ConfigError("bodies must name at least one rigid body")
        if not all(isinstance(name, str) and name for name in self.names):
            raise ConfigError(f"base and bodies must be names, got {self.names}")
        if len(set(self.names)) != len(self.names):
            raise ConfigError(f"base and bodies must all differ, got {self.names}")
        for name, length in (("base_offset", 3), ("base_quaternion", 4)):
            values = getattr(self, name)
            if len(values) != length:
                raise ConfigError(f"{name} must have {length} numbers, got {values}")
            if not all(map(math.isfinite, values)):
                raise ValueRangeError(f"{name} must be finite, got {values}")
        if abs(math.hypot(*self.base_quaternion) - 1.0) > EXACT:
            raise ValueRangeError(f"base_quaternion must have length 1, got {self.base_quaternion}")
        if self.timeout <= self.max_age:
            raise ValueRangeError(f"timeout must be longer than max_age, got {self.timeout} and {self.max_age}")

    @property
    def names(self) -> tuple[str, ...]:
        """All rigid bodies, the base first."""
        return (self.base, *self.bodies)


def check_address(name: str, text: str, multicast: bool = False) -> None:
    """Raises ConfigError where a setting is not one IPv4 address, of a multicast group or not."""
    try:
        address = ipaddress.IPv4Address(text)
    except ValueError as error:
        raise ConfigError(f"{name} must be an IPv4 address, got {text!r}") from error
    if address.is_multicast != multicast:
        raise ConfigError(f"{name} must {'' if multicast else 'not '}be a multicast address, got {text}")
    if address.is_unspecified:
        raise ConfigError(f"{name} must be one address, not {text}, which is all of them")
