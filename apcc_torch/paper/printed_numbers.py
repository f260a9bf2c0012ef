"""What the paper publishes of section V-B and Appendix A, number by number, with the figure that shows it.

Where the print contradicts itself the reading taken is said in a note, and a number that cannot be right is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Published(NamedTuple):
    """One comparison of the paper, in the units of the metric it stands for.

    standard, adaptive: The controllers' values, or None where only a change is given.
    change: Percent of the standard controller's value, negative for less; a (least, largest) pair over the sensors.
    source: The paper's figure.
    note: How the print was read.
    """

    standard: float | None
    adaptive: float | None
    change: float | tuple[float, float] | None
    source: str
    note: str = ""


_PSI_UNITS = (
    "the paper prints the mean of Psi in cm^2 and its bounds in mm; Eq. (50) is a length and the mean lies between the "
    "bounds only if all are cm"
)
_BOUNDS = "the paper does not say how its bounds are taken over time; they stand beside both readings"
_EXECUTION = "the paper says only 'during task execution'; read as the mean over time"

_PRINTED: Mapping[str, Mapping[str, Published]] = {
    "run_1": {
        "shape_error_mean_mm": Published(1.82, 1.31, -28.0, "fig. 11"),
        "shape_error_min_mm": Published(0.19, 0.17, -7.0, "fig. 11"),
        "shape_error_max_mm": Published(3.32, 2.60, -21.7, "fig. 11"),
        "psi_mean_cm": Published(4.61, 1.94, -57.9, "fig. 12", _PSI_UNITS),
        "psi_min_cm": Published(2.71, 0.24, -91.2, "fig. 12", _PSI_UNITS),
        "psi_max_cm": Published(8.45, 6.11, -27.6, "fig. 12", _PSI_UNITS),
    },
    "run_2": {
        "shape_error_mean_mm": Published(6.82, 4.87, -28.6, "fig. 17"),
        "shape_error_min_mm": Published(1.03, 1.10, 6.32, "fig. 17"),
        "shape_error_max_mm": Published(12.9, 8.17, -36.7, "fig. 17"),
        "psi_mean_cm": Published(None, None, -51.9, "fig. 18"),
        "psi_min_cm": Published(None, None, -92.1, "fig. 18"),
        "psi_max_cm": Published(None, None, -38.1, "fig. 18"),
    },
    "run_2_single": {
        "shape_error_mean_mm": Published(12.33, 6.68, -45.8, "fig. 15", _EXECUTION),
        "sensor_error_linear_mean_mm": Published(None, None, (-86.0, -62.0), "fig. 16"),
        "sensor_error_angular_mean_rad": Published(None, None, (-90.0, -84.0), "fig. 16"),
        "sensor_3_error_linear_mean_mm": Published(
            40.0, 5.0, None, "figs. 14, 16", "the paper says more than 4 cm against less than 0.5 cm at the tip"
        ),
    },
    "robot_2": {
        "shape_error_min_mm": Published(0.55, 0.58, 5.82, "fig. 40"),
        "shape_error_max_mm": Published(5.16, 4.15, -19.4, "fig. 40"),
        "psi_mean_cm": Published(None, None, -25.8, "fig. 42"),
        "psi_min_cm": Published(None, None, -36.1, "fig. 42"),
        "psi_max_cm": Published(None, None, -17.8, "fig. 42"),
    },
}
_EDGES = {
    "shape_error_min_mm": "shape_error_lower_edge_mm",
    "shape_error_max_mm": "shape_error_upper_edge_mm",
    "psi_min_cm": "psi_lower_edge_cm",
    "psi_max_cm": "psi_upper_edge_cm",
}


def _with_edges(printed: Mapping[str, Published]) -> dict[str, Published]:
    """The paper's bounds under both readings."""
    edges = {edge: printed[bound]._replace(note=_BOUNDS) for bound, edge in _EDGES.items() if bound in printed}
    return {**printed, **edges}


PUBLISHED: Mapping[str, Mapping[str, Published]] = {run: _with_edges(printed) for run, printed in _PRINTED.items()}
"""Run -> metric -> what the paper says of it."""

LEFT_OUT: Mapping[str, str] = {
    "robot_2": "Appendix A's mean shape error is left out: it repeats run II's and exceeds its own maximum"
}
"""Run -> which of its published numbers are not shown, and why."""

TITLES: Mapping[str, str] = {
    "run_1": "run I, section V-B: arm 1, positions only",
    "run_2": "run II, section V-B: arm 1, full poses",
    "robot_2": "Appendix A: arm 2, full poses",
}
"""Run -> what it is."""


def published(run: str, metric: str) -> Published | None:
    """What the paper says of a metric of a run, or None."""
    return PUBLISHED.get(run, {}).get(metric)
