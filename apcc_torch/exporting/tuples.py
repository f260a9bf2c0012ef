"""What the functions of a library take and give, beside what controllers and plants have."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Beginning(NamedTuple):
    """Where a controller begins.

    q: (n,) first guess of the configuration. pi_hat: (n_b,) m. time: () s, before the first measurement.
    """

    q: Tensor
    pi_hat: Tensor
    time: Tensor


class Answer(NamedTuple):
    """What a control step tells.

    The command: y (n_a,) m, q_d and qdot (n,), force (n_a,) N or None, pressure (n_a,) Pa or None. The estimate: q_bar
    (n,), pi_hat (n_b,) m, status (), iterations (), angular_error and linear_error (k,), load () kg or None. e (3,) m
    and limits () as `Command` has them.
    """

    y: Tensor
    q_d: Tensor
    qdot: Tensor
    force: Tensor | None
    pressure: Tensor | None
    e: Tensor
    limits: Tensor
    q_bar: Tensor
    pi_hat: Tensor
    status: Tensor
    iterations: Tensor
    angular_error: Tensor
    linear_error: Tensor
    load: Tensor | None


class Uncertainty(NamedTuple):
    """How sure an estimate is.

    covariance: (n, n) of q_bar.
    """

    covariance: Tensor


class ShapeUncertainty(NamedTuple):
    """How sure the estimate of a shape is.

    covariance: (n + 1, n + 1) of the strains of its sections, and of the load, which is last.
    """

    covariance: Tensor


class TendonInput(NamedTuple):
    """What a loop on the tendons' lengths needs to know.

    y, ydot: (n_a,) m, m/s, measured. y_d, ydot_d: (n_a,) m, m/s, wanted. force: (n_a,) N, feed-forward; None for none.
    dt: () s, of its period.
    """

    y: Tensor
    ydot: Tensor
    y_d: Tensor
    ydot_d: Tensor
    force: Tensor | None
    dt: Tensor


class TendonForces(NamedTuple):
    """u: (n_a,) N, tension is -u."""

    u: Tensor


class TendonMemory(NamedTuple):
    """z: (n_a,) m s, the integral of a tendon loop's error."""

    z: Tensor
