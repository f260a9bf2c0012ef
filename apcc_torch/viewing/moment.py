"""One instant of an arm, as numbers: what a scene shows."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

Array = NDArray[Any]


class Moment(NamedTuple):
    """One instant, world frame, m; None for what is not known.

    sections: (S, P, 3) centre lines of the arm's sections, from the base to the tip.
    tendons: (n_a, Q, 3) paths, NaN where a tendon does not run.
    tension: (n_a,) N.
    sensors: (k, 4, 4) poses, NaN where one is not seen; (k, 3) where only their places are known.
    covariance: (k, 3, 3) m^2, of the sensors' places.
    model: (M, 3) centre line of the virtual model.
    target: (3,) of the tip, or (G, 3) of the backbone.
    """

    sections: Array
    tendons: Array | None = None
    tension: Array | None = None
    sensors: Array | None = None
    covariance: Array | None = None
    model: Array | None = None
    target: Array | None = None

    @property
    def tip(self) -> Array:
        """(3,) the arm's end, m."""
        tip: Array = self.sections[-1, -1]
        return tip
