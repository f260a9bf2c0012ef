"""What a controller that looks ahead remembers beside what every controller does."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from torch import Tensor

from apcc_torch.estimation.momentum_observer import ObserverState


class AheadStatus(IntEnum):
    """What a command takes from a look ahead.

    NONE: Nothing: none was made in time, and Eq. (16) stands alone. FOLLOWED: The departure that was found.
    NOT_BETTER: Nothing, it costs more than none. NOT_FINITE: Nothing, the model has no finite way.
    """

    NONE = 0
    FOLLOWED = 1
    NOT_BETTER = 2
    NOT_FINITE = 3


class Ahead(NamedTuple):
    """Of a `LookaheadController`.

    knots: (..., k, 3 + n) departure from Eq. (16), m/s, rad/s and m/s. age: (...) s since it began.
    status: (...) `AheadStatus` of the last command. next: (...) of the one that comes, NONE until there is a look
    ahead. number: (...) int64, looks so far.
    q: (..., n) of the arm's sections as they were built, and rate: (..., n) its velocity behind a low-pass.
    pi_hat: (..., n_b) m, that q_bar is of. x: (..., 3) m, the tip. y: (..., n_a) m, the last command, and
    ydot: (..., n_a) m/s, its rate. u: (..., n_a) N, the tendons' forces as they are believed.
    observer: Of what else acts on the arm. payload: (...) kg believed.
    """

    knots: Tensor
    age: Tensor
    status: Tensor
    next: Tensor
    number: Tensor
    q: Tensor
    rate: Tensor
    pi_hat: Tensor
    x: Tensor
    y: Tensor
    ydot: Tensor
    u: Tensor
    observer: ObserverState
    payload: Tensor
