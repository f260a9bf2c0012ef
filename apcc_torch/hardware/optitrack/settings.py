"""What the OptiTrack sensor is told beside what any motion capture is: addresses."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.hardware.mocap.settings import MocapSettings, check_address
from apcc_torch.settings import OURS, setting


@dataclass(frozen=True, kw_only=True)
class OptiTrackSettings(MocapSettings):
    """Settings of an `OptiTrackSensor`, in SI units.

    Raises:
        ConfigError: An address, a name or a choice is wrong.
        ValueRangeError: A number is out of its range.
    """

    server: str = setting(
        "127.0.0.1", "", OURS, "IPv4 address of the computer with Motive; packets from any other are dropped"
    )
    interface: str = setting(
        "127.0.0.1", "", OURS, "IPv4 address of this computer on that network; nothing listens elsewhere"
    )
    multicast: bool = setting(False, "", OURS, "whether Motive streams by multicast; false: unicast")
    group: str = setting("239.255.42.99", "", OURS, "Motive's multicast group")
    command_port: int = setting(1510, "", OURS, "Motive's", least=1, most=65535)
    data_port: int = setting(1511, "", OURS, "Motive's; unicast does not use it", least=1, most=65535)
    keepalive: float = setting(0.5, "s", OURS, "between two signs of life to a unicast server", above=0)

    def check(self) -> None:
        """Raises where names, addresses or numbers do not fit each other."""
        super().check()
        for name in ("server", "interface", "group"):
            check_address(name, getattr(self, name), multicast=name == "group")
