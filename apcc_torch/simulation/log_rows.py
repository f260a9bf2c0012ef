"""The rows of a log as they come, one tensor a field in the end."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class Rows:
    """Collects `steps` rows of tensors of constant shapes.

    Without gradients each row is copied to its place at once, so that the log of a large batch is never held twice, not
    even in part. With gradients the rows stay apart until the end: writing in place would be recorded step by step.

    Args:
        steps: How many rows there will be.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.count = 0
        self._whole: list[Tensor] = []
        self._apart: list[list[Tensor]] = []

    def add(self, row: Sequence[Tensor]) -> None:
        """One more row, the same fields every time."""
        if torch.is_grad_enabled():
            if not self._apart:
                self._apart = [[] for _ in row]
            for column, value in zip(self._apart, row, strict=True):
                column.append(value)
        else:
            if not self._whole:
                self._whole = [value.new_empty((self.steps, *value.shape)) for value in row]
            for whole, value in zip(self._whole, row, strict=True):
                whole[self.count].copy_(value)
        self.count += 1

    def stacked(self) -> list[Tensor]:
        """The fields, (steps, ...) each."""
        if self._apart:
            return [torch.stack(self._apart.pop(0)) for _ in range(len(self._apart))]
        return [whole[: self.count] for whole in self._whole]
