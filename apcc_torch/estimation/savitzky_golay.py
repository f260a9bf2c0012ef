"""Causal Savitzky-Golay filter: a running least-squares polynomial, read at the newest time stamp.

The paper estimates the configuration's rate by such a filter, its window a constant N. Here the buffer is an explicit
state, stamps may be uneven and samples may be missing.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.part import Part, hold_rows, refuse_parameter
from apcc_torch.settings import MANY, OURS, Settings, resolved, setting
from apcc_torch.shapes import batch_shape, check_same, check_stamps, check_tensor, coarse_stamps


class SavitzkyGolayState(NamedTuple):
    """The last N samples, oldest first.

    Attributes:
        samples: Samples, shape (..., N, n); zero where not valid.
        times: Time stamps in s, shape (..., N); also set where a sample is missing.
        valid: Which samples count, bool, shape (..., N).
    """

    samples: Tensor
    times: Tensor
    valid: Tensor


class SavitzkyGolayFit(NamedTuple):
    """The fitted polynomial at the newest time stamp: `value` and `derivative`, shape (..., n)."""

    value: Tensor
    derivative: Tensor


Scalar = Tensor | float
_SHORTEST = 1e-12  # s; stamps closer than this are one


def _times(c: Scalar, x: Scalar) -> Scalar:
    """c x; with a constant 0 or 1 no operation is spent."""
    if isinstance(c, float) and c in (0.0, 1.0):
        return x if c == 1.0 else 0.0
    return x if isinstance(x, float) and x == 0.0 else c * x


def _plus(x: Scalar, y: Scalar) -> Scalar:
    """x + y; with a constant 0 no operation is spent."""
    if isinstance(x, float) and x == 0.0:
        return y
    return x if isinstance(y, float) and y == 0.0 else x + y


def _fitted(name: str, x: Tensor, shape: tuple[int, ...]) -> Tensor:
    """x, broadcast to the state's batch; most calls need no operation."""
    if x.shape == shape:
        return x
    try:
        return x.expand(shape)
    except RuntimeError as error:
        raise ShapeError(f"{name} of shape {tuple(x.shape)} does not fit the state's batch, {shape} wanted") from error


def polynomial_weights(
    times: Tensor, valid: Tensor, order: int, derivatives: tuple[int, ...], importance: Tensor | None = None
) -> list[Tensor]:
    """Weights that turn samples into derivatives of their least-squares polynomial at the last time stamp.

    The polynomial is expanded in the polynomials p_k that are orthogonal over the valid stamps, built by Stieltjes'
    recurrence p_k+1 = (t - a_k) p_k - b_k p_k-1. One whose norm vanishes (no more distinct stamps than its degree)
    adds nothing, so the order falls to the number of distinct valid stamps less one by itself, without a branch or
    a linear solve.

    Args:
        times: Stamps relative to the last, in s, last entry 0, shape (..., N).
        valid: 1 where the sample counts, else 0, same dtype, shape (..., N).
        order: Degree of the polynomial.
        derivatives: Which derivatives, at most `order`, 0 for the value.
        importance: Weights of the squares, at most 1 and positive, shape (..., N); None: all 1.

    Returns:
        One tensor of shape (..., N) per entry of `derivatives`, in 1 / s^derivative.
    """
    # In units of the oldest valid stamp, t runs from 1 to 0; the clamp only keeps 0 / 0 away.
    scale = (times * valid).amin(-1, keepdim=True).clamp(max=-_SHORTEST)
    t = times / scale
    # The squared norm that rounding leaves of a polynomial that vanishes on every valid stamp.
    floor = times.shape[-1] * (64 * torch.finfo(times.dtype).eps) ** 2
    lowest, highest = min(derivatives), max(derivatives)
    weights: list[Scalar] = [0.0] * len(derivatives)
    p_old = p = valid  # p_k at the stamps, 0 where not valid; p_0 = 1
    norm_old: Scalar = 1.0
    # at[m]: the m-th derivative of p_k at t = 0; at_old: that of p_k-1.
    at_old: list[Scalar] = [0.0] * (highest + 1)
    at: list[Scalar] = [1.0, *at_old[1:]]
    for degree in range(order + 1):
        counted = p if importance is None else p * importance
        norm = (p * counted if degree else counted).sum(-1, keepdim=True)
        safe = torch.threshold(norm, floor, math.inf)  # dividing by inf drops the polynomial
        q = counted / safe
        weights = [_plus(w, _times(at[m], q)) for w, m in zip(weights, derivatives, strict=True)]
        if degree == order:
            break
        tp = t * p
        a = (tp * q).sum(-1, keepdim=True)
        p_next = torch.addcmul(tp, a, p, value=-1)
        b: Scalar = 0.0
        if degree:
            b = norm / norm_old
            p_next = torch.addcmul(p_next, b, p_old, value=-1)
        used = max(lowest - (order - degree - 1), 0)  # no later polynomial needs a derivative below this
        minus_a, minus_b = -a, _times(b, -1.0)
        at_next: list[Scalar] = [0.0] * (highest + 1)
        for m in range(used, highest + 1):
            risen = _times(float(m), at[m - 1]) if m else 0.0
            at_next[m] = _plus(risen, _plus(_times(at[m], minus_a), _times(at_old[m], minus_b)))
        p_old, p, at_old, at, norm_old = p, p_next, at, at_next, safe
    fitted = [(w, m) for w, m in zip(weights, derivatives, strict=True) if isinstance(w, Tensor)]
    return [w / scale**m if m > 1 else w / scale if m else w for w, m in fitted]


@dataclass(frozen=True, kw_only=True)
class SavitzkyGolaySettings(Settings):
    """Settings of `SavitzkyGolay`."""

    window: int | Tensor = setting(
        15, "samples", OURS, "N, the samples in the window", rows="number", least=1, most=MANY
    )
    order: int = setting(2, "", OURS, "degree of the polynomial, less than the window", least=0, most=20)
    derivative: int = setting(1, "", OURS, "which derivative, at most the order", least=0, key=False)
    period: float | None = setting(
        None, "s", OURS, "sampling period; null: the samples' own stamps", above=0, key=False
    )

    def check(self) -> None:
        """Raises where the window is too short for the order, or the order for the derivative."""
        if self.order < self.derivative:
            raise ValueRangeError(f"order must be at least derivative = {self.derivative}, got {self.order}")
        rows = isinstance(self.window, Tensor)
        shortest = int(self.window.min()) if isinstance(self.window, Tensor) else self.window
        if shortest < self.order + 1:
            raise ValueRangeError(f"window must be at least order + 1 = {self.order + 1}, got {shortest}")
        if self.period is not None and rows:
            raise ValueRangeError("a window for each row needs the samples' own stamps: period must be None")


class SavitzkyGolay(Part):
    """Derivative of the least-squares polynomial over the last N samples, at the newest time stamp.

    With fewer than order + 1 valid samples at distinct stamps the order drops to their number less one: one sample
    gives a zero derivative, two their slope. A sample that is not finite counts as missing. Where the newest samples
    are missing, the polynomial is extrapolated to the given stamp; once no valid sample is left the result is 0.

    With `period` set, samples are taken as evenly spaced whatever their stamps, by coefficients computed once for
    every fill of the buffer; a missing sample is then replaced by the one before it (held).

    Stamps keep their own dtype, so float32 samples may carry float64 stamps, as large stamps need. A stamp must be
    finite and not before the one before it.

    Args:
        *settings, **changes: See `SavitzkyGolaySettings`. A window may be a tensor (...) of whole numbers, one a row.

    Raises:
        ValueRangeError: A setting is out of its range.

    Example:
        >>> derivative = SavitzkyGolay(window=5, order=2)
        >>> state = derivative.initial_state(torch.zeros(1), torch.tensor(0.0))
        >>> for k in range(5):
        ...     state, rate = derivative(state, torch.tensor([0.1 * k]) ** 2, torch.tensor(0.1 * k))
        >>> rate
        tensor([0.8000])
    """

    settings_type = SavitzkyGolaySettings
    window: int | Tensor
    order: int
    derivative: int
    period: float | None
    table: Tensor | None
    newest: Tensor | None

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(SavitzkyGolaySettings, settings, changes)
        refuse_parameter("window", s.window, "it counts samples; a SoftWindow has weights to train")
        self.hold(s)

    def _hold_one(self, name: str, value: Any, trailing: int) -> None:
        # A window a row makes constants; it is no tensor of the computation.
        setattr(self, name, value)

    def derive(self) -> None:
        """The buffer's length N, which of a row's samples are in its window, and the weights of even samples."""
        window = self.window
        self.length = int(window.max()) if isinstance(window, Tensor) else window
        # A row's shorter window is the newest part of the longest one.
        age = torch.arange(self.length - 1, -1, -1)
        newest = age.to(window.device) < window.unsqueeze(-1) if isinstance(window, Tensor) else None
        hold_rows(self, False, newest=(newest, 1))
        table = None
        if self.period is not None:
            # Row m of each table: coefficients while the buffer holds m samples.
            times = self.period * torch.arange(1 - self.length, 1, dtype=torch.float64)
            filled = torch.ones(self.length + 1, self.length, dtype=torch.float64).tril(-1).flip(-1)
            rows = polynomial_weights(times.expand_as(filled), filled, self.order, (self.derivative, 0))
            table = torch.stack(rows)
        self.register_buffer("table", table, persistent=False)

    def initial_state(self, sample: Tensor, time: Tensor) -> SavitzkyGolayState:
        """An empty buffer that fits `sample`; the sample itself is not put in.

        Args:
            sample: A sample, for its shape, dtype and device, shape (..., n).
            time: Time stamp at or before the first sample in s, shape (...).

        Raises:
            ValueRangeError: The stamp's dtype does not tell milliseconds apart; where only a later one does not, `push`
                warns.
        """
        check_tensor("sample", sample, (None,))
        check_stamps("time", check_tensor("time", time, ()))
        batch = batch_shape(sample=(sample, 1), time=(time, 0))
        return SavitzkyGolayState(
            sample.new_zeros((*batch, self.length, sample.shape[-1])),
            time.detach().expand(batch).unsqueeze(-1).repeat(*[1] * len(batch), self.length),
            torch.zeros((*batch, self.length), dtype=torch.bool, device=sample.device),
        )

    def push(
        self, state: SavitzkyGolayState, sample: Tensor, time: Tensor, valid: Tensor | None = None
    ) -> SavitzkyGolayState:
        """The buffer with one more sample; arguments as in `forward`."""
        n = state.samples.shape[-1]
        check_tensor("sample", sample, (n,))
        check_tensor("time", time, ())
        check_same(sample=sample, state=state.samples)
        # A run is not ended for it; on an accelerator the question would wait for the queue.
        if time.dtype is not torch.float64 and time.is_cpu and (fault := coarse_stamps("time", time)):
            warnings.warn(fault, stacklevel=2)
        batch = state.times.shape[:-1]
        # x * 0 is 0 for finite x only, and one sum then tells of the whole sample.
        ok = (sample * 0).sum(-1) == 0
        ok = ok if valid is None else ok & valid
        if self.period is None:
            kept = torch.where(ok.unsqueeze(-1), sample, 0.0)
        else:
            kept = torch.where(ok.unsqueeze(-1), sample, state.samples[..., -1, :])
            ok = ok | state.valid[..., -1]
        kept = _fitted("sample", kept, (*batch, n))
        time, ok = _fitted("time", time, tuple(batch)), _fitted("valid", ok, tuple(batch))
        return SavitzkyGolayState(
            torch.cat((state.samples[..., 1:, :], kept.unsqueeze(-2)), -2),
            torch.cat((state.times[..., 1:], time.unsqueeze(-1)), -1),
            torch.cat((state.valid[..., 1:], ok.unsqueeze(-1)), -1),
        )

    def _weights(self, state: SavitzkyGolayState, with_value: bool) -> list[Tensor]:
        if self.table is not None:
            row = state.valid.sum(-1)
            return [part[row] for part in self.table.to(state.samples)[: 2 if with_value else 1]]
        times = (state.times - state.times[..., -1:]).to(state.samples.dtype)
        wanted = (self.derivative, 0) if with_value else (self.derivative,)
        valid = state.valid if self.newest is None else state.valid & self.newest
        return polynomial_weights(times, valid.to(times.dtype), self.order, wanted, self._importance(times))

    def _importance(self, like: Tensor) -> Tensor | None:
        """Weights of the samples' squares (..., N) of the dtype and device of `like`; None: all 1."""
        return None

    def evaluate(self, state: SavitzkyGolayState) -> SavitzkyGolayFit:
        """The polynomial over `state`'s samples at its newest stamp: the smoothed value and the derivative."""
        derivative, value = ((w.unsqueeze(-2) @ state.samples).squeeze(-2) for w in self._weights(state, True))
        return SavitzkyGolayFit(value, derivative)

    def forward(
        self, state: SavitzkyGolayState, sample: Tensor, time: Tensor, valid: Tensor | None = None
    ) -> tuple[SavitzkyGolayState, Tensor]:
        """Takes one sample in and returns the derivative at its stamp.

        Args:
            state: The buffer.
            sample: New sample, shape (..., n).
            time: Its stamp in s, shape (...).
            valid: False where the sample is missing, bool, shape (...); None: all present.

        Returns:
            The new buffer and the derivative, shape (..., n), in units of the sample / s^derivative.

        Raises:
            DtypeError: `sample` or `time` is not floating, or `sample` has another dtype than the state.
            ShapeError: `sample`, `time` or `valid` does not fit the state.
        """
        state = self.push(state, sample, time, valid)
        (weights,) = self._weights(state, False)
        return state, (weights.unsqueeze(-2) @ state.samples).squeeze(-2)
