"""What a controller that looks ahead remembers beside what every controller does."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from torch import Tensor


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
    q: (..., n_f) of the arm's pieces, moved: (..., n_f) its mean velocity since the step before, and rate: (..., n_f)
    that behind a low-pass. x: (..., 3) m, the tip. y: (..., n_a) m, the last command, and ydot: (..., n_a) m/s, its
    rate. u: (..., n_a) N, the tendons' forces as they are believed.
    r: (..., n_f) N m and N, generalized force that the arm alone does not explain, and w: (..., n_f) that of a kg at
    the tip, both behind a low-pass; weighed, explained: (...) what was seen of w and of r along it. payload: (...) kg,
    and d: (..., n_f) what it leaves. known: (...) int64, steps in which something of this was measured, up to two.
    """

    knots: Tensor
    age: Tensor
    status: Tensor
    next: Tensor
    number: Tensor
    q: Tensor
    moved: Tensor
    rate: Tensor
    x: Tensor
    y: Tensor
    ydot: Tensor
    u: Tensor
    r: Tensor
    w: Tensor
    weighed: Tensor
    explained: Tensor
    d: Tensor
    payload: Tensor
    known: Tensor
