"""What the receiver counts, as plain numbers for a log."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field


@dataclass
class Counts:
    """Counts since the sensor was connected. One thread writes; `copy` gives a state that stays.

    Attributes:
        packets: Datagrams that came, of any kind and from anyone.
        foreign: Dropped: from another sender than the server.
        malformed: Dropped: cut or damaged.
        unexpected: Datagrams of another kind than those the receiver uses.
        skipped: Passed over, for newer ones were waiting.
        failed: Datagrams whose handling failed in a way that was not foreseen.
        socket_errors: Failed calls to the network.
        frames: Frames that became a sample.
        repeated: Frames with the number of the frame before: duplicates, or a source that stands still.
        out_of_order: Frames with a lower number, dropped.
        missed: Frame numbers that never came.
        late: Frames that were older than `max_age` when they came.
        restarts: Times that the frame numbers began anew.
        losses: Times that no new frame came for `timeout`.
        clock_steps: Times that the server's clock was set.
        bodies: Body -> reason -> number of samples in which it was not valid for that reason.
    """

    packets: int = 0
    foreign: int = 0
    malformed: int = 0
    unexpected: int = 0
    skipped: int = 0
    failed: int = 0
    socket_errors: int = 0
    frames: int = 0
    repeated: int = 0
    out_of_order: int = 0
    missed: int = 0
    late: int = 0
    restarts: int = 0
    losses: int = 0
    clock_steps: int = 0
    bodies: dict[str, dict[str, int]] = field(default_factory=dict)

    def reject(self, body: str, reason: str) -> None:
        """Counts a body that is not valid in a sample."""
        reasons = self.bodies.setdefault(body, {})
        reasons[reason] = reasons.get(reason, 0) + 1

    def copy(self) -> Counts:
        """These counts as they are now."""
        return copy.deepcopy(self)
