"""A Savitzky-Golay window without an edge: each sample has a weight, which gradients can tune."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.modes import holds
from apcc_torch.part import hold_rows
from apcc_torch.shapes import check_positive, check_tensor


class SoftWindow(SavitzkyGolay):
    """Derivative of the polynomial that fits the last N samples best by weighted squares, at the newest time stamp.

    With equal weights it is `SavitzkyGolay`. Whatever they are, it is exact on polynomials of its order, also while
    the buffer fills and where samples are missing or uneven. Its result is differentiable in the weights, which are
    positive: tune their logarithms.

    Args:
        weights: (..., N) positive weights of the squares, the newest sample's last; only their ratios matter.
        order: Degree of the polynomial, less than N.
        derivative: Which derivative, at most `order`; None for that of `SavitzkyGolay`.

    Raises:
        ShapeError, ValueRangeError: An argument is out of its range.

    Example:
        >>> window = SoftWindow(torch.tensor([0.2, 0.5, 1.0]).double(), order=1)
        >>> state = window.initial_state(torch.zeros(1).double(), torch.tensor(0.0).double())
        >>> for time in torch.tensor([0.1, 0.2, 0.3]).double():
        ...     state, slope = window(state, 2.0 * time.unsqueeze(-1), time)
        >>> slope
        tensor([2.0000], dtype=torch.float64)
    """

    weights: Tensor

    def __init__(self, weights: Tensor, order: int, derivative: int | None = None) -> None:
        check_positive("weights", check_tensor("weights", weights, (None,)))
        super().__init__(weights.shape[-1], order, *(() if derivative is None else (derivative,)))
        if not holds(weights.amin(-1) / weights.amax(-1) >= torch.finfo(weights.dtype).eps):
            raise ValueRangeError("weights must not differ by more than the number of digits of their dtype")
        hold_rows(self, weights=(weights, 1))

    def _importance(self, like: Tensor) -> Tensor:
        return (self.weights / self.weights.amax(-1, keepdim=True)).to(like)
