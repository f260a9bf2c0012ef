"""What the Qualisys sensor is told beside what any motion capture is: addresses, and how frames come."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.hardware.mocap.settings import MocapSettings, check_address
from apcc_torch.settings import OURS, setting


@dataclass(frozen=True, kw_only=True)
class QualisysSettings(MocapSettings):
    """Settings of a `QualisysSensor`, in SI units.

    Raises:
        ConfigError: An address, a name or a choice is wrong.
        ValueRangeError: A number is out of its range.
    """

    server: str = setting(
        "127.0.0.1", "", OURS, "IPv4 address of the computer with QTM; packets from any other are dropped"
    )
    interface: str = setting(
        "127.0.0.1", "", OURS, "IPv4 address of this computer on that network; nothing listens elsewhere"
    )
    port: int = setting(22223, "", OURS, "QTM's for little endian: its base port and one", least=1, most=65535)
    transport: str = setting(
        "udp", "", OURS, "of frames; a lost datagram delays nothing, a lost segment does", choices=("udp", "tcp")
    )
    scale: float = setting(1e-3, "m", OURS, "in a streamed unit; QTM streams mm", above=0)

    def check(self) -> None:
        """Raises where names, addresses or numbers do not fit each other."""
        super().check()
        for name in ("server", "interface"):
            check_address(name, getattr(self, name))
