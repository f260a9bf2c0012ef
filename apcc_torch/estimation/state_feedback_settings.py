"""Settings of algorithm 2."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.errors import ValueRangeError
from apcc_torch.settings import MANY, OURS, PAPER, Setting, Settings, setting

MODES = ("position", "pose", "hierarchical")
GRADIENTS = ("implicit", "unrolled")


@dataclass(frozen=True, kw_only=True)
class StateFeedbackSettings(Settings):
    """Settings of `StateFeedback`."""

    mode: str = setting(
        "pose",
        "",
        PAPER,
        "position, Eq. (32); pose, Eqs. (28)-(31); hierarchical, positions first and orientations in their null space",
        choices=MODES,
    )
    angular_weight: Setting = setting(
        1.0, "m/rad", PAPER, "metres that one radian counts as; 0.1 fits positions far better", rows="number", above=0
    )
    max_iterations: int = setting(7, "", PAPER, "largest number of steps, N", least=1, most=MANY)
    min_iterations: int = setting(
        1, "", OURS, "steps taken even within the thresholds: slow motion is not quantised", least=0, key=False
    )
    linear_threshold: Setting = setting(1e-4, "m", PAPER, "error that ends the iteration", rows="number", above=0)
    angular_threshold: Setting = setting(5e-3, "rad", PAPER, "error that ends the iteration", rows="number", above=0)
    bend_step: Setting = setting(
        0.6, "rad", OURS, "largest change of a bend in one step", rows="number", above=0, key=False
    )
    length_step: Setting = setting(
        0.1, "m", OURS, "largest change of an elongation in one step", rows="number", above=0, key=False
    )
    damping: Setting = setting(
        1e-8, "m^2", OURS, "first Levenberg-Marquardt damping", rows="number", above=0, key=False
    )
    settled_step: Setting = setting(
        5e-6, "rad, m", OURS, "a smaller step is the row's last", rows="number", least=0, key=False
    )
    gradient: str = setting(
        "implicit",
        "",
        OURS,
        "implicit, of the fixed point; unrolled, through every step in reverse mode",
        choices=GRADIENTS,
        key=False,
    )

    def check(self) -> None:
        """Raises where the least number of iterations is above the largest."""
        if self.min_iterations > self.max_iterations:
            raise ValueRangeError(f"min_iterations must be at most max_iterations, got {self.min_iterations}")
