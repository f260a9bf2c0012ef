"""What the sensors tell of the arm, row by row late and noisy, and how fast they seem to move."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.envs.streams import Stream


class Readings(NamedTuple):
    """Sensor positions on their way to the observer.

    queue: (N, D + 1, 9) readings as they were taken, m, the newest first.
    seen: (N, 9) the one that is seen now.
    before: (N, 9) the one that was seen a control period ago.
    """

    queue: Tensor
    seen: Tensor
    before: Tensor


class Sensing:
    """The position sensors of N arms.

    Args:
        noisy: Whether any row has noise; without, none is drawn.
        longest: Largest delay of any row, control periods.
    """

    def __init__(self, noisy: bool, longest: int) -> None:
        self.noisy, self.longest = noisy, longest

    def initial(self, positions: Tensor, rows: RowParameters, stream: Stream) -> tuple[Stream, Readings]:
        """The streams, and readings of sensors that have long seen these positions (N, 9), m."""
        stream, taken = self._taken(positions, rows, stream)
        return stream, Readings(taken.unsqueeze(1).repeat(1, self.longest + 1, 1), taken, taken)

    def read(
        self, readings: Readings, positions: Tensor, rows: RowParameters, stream: Stream
    ) -> tuple[Stream, Readings]:
        """The streams, and the readings a control period later, at true positions (N, 9), m."""
        stream, taken = self._taken(positions, rows, stream)
        if not self.longest:
            return stream, Readings(taken.unsqueeze(1), taken, readings.seen)
        queue = torch.cat((taken.unsqueeze(1), readings.queue[:, :-1]), dim=1)
        late = rows.delay.view(-1, 1, 1).expand(-1, 1, queue.shape[-1])
        return stream, Readings(queue, queue.gather(1, late).squeeze(1), readings.seen)

    def _taken(self, positions: Tensor, rows: RowParameters, stream: Stream) -> tuple[Stream, Tensor]:
        if not self.noisy:
            return stream, positions
        stream, noise = stream.normal(positions.shape[-1], positions.dtype)
        return stream, positions + rows.noise.unsqueeze(-1) * noise
