"""Packets that never end the thread that takes them: what is foreign, damaged or a bug is counted, told and dropped."""

from __future__ import annotations

from collections.abc import Callable

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.limited_log import LimitedLog


def guarded(call: Callable[[], None], counts: Counts, log: LimitedLog) -> None:
    """Calls it; whatever it raises is counted and logged, and the thread goes on."""
    try:
        call()
    except CommunicationError as error:
        counts.malformed += 1
        log.warning("malformed", "dropped a packet: %s", error)
    except Exception:
        counts.failed += 1
        log.warning("failed", "the handling of a packet failed", trace=True)


def foreign(sender: str, server: str, counts: Counts, log: LimitedLog) -> bool:
    """Whether a packet that came is of another sender than the server; it is counted either way, and told if it is."""
    counts.packets += 1
    if sender == server:
        return False
    counts.foreign += 1
    log.warning("foreign", "dropped a packet from %s, which is not the server", sender)
    return True
