"""The numbers of an instant of a run, as a message of the kind that logs have: Foxglove plots each of them."""

from __future__ import annotations

from typing import NamedTuple

from apcc_torch.hardware.log_format import TIME, Field, Layout
from apcc_torch.viewing.moment import Array

TOPIC = "/run"


class Numbers(NamedTuple):
    """What an instant of a run has in numbers.

    time: s since the start. error: m, from the tip to the target. target, tip: (3,) m. q: (n,) of the drawn arm.
    pi_hat: (n_b,) estimated rest lengths, m. tension: (n_a,) N, NaN where it is not known.
    """

    time: float
    error: float
    target: Array
    tip: Array
    q: Array
    pi_hat: Array
    tension: Array


def run_layout(n: int, n_b: int, n_a: int) -> Layout:
    """The layout of `Numbers`.

    Args:
        n: Coordinates of the drawn configuration.
        n_b: Sections of the controller's model.
        n_a: Tendons.

    Example:
        >>> print(run_layout(9, 3, 9).definition.splitlines()[1])
        float64 error  # m, from the tip to the target
    """
    return Layout(
        "Run",
        TOPIC,
        (
            TIME,
            Field("error", "float64", None, "m, from the tip to the target"),
            Field("target", "float64", 3, "m, frame world"),
            Field("tip", "float64", 3, "m, frame world"),
            Field("q", "float64", n, "rad, rad, m a section, of the drawn arm"),
            Field("pi_hat", "float64", n_b, "m, estimated rest lengths"),
            Field("tension", "float64", n_a, "N, NaN where it is not known"),
        ),
    )
