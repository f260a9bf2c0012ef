"""Rest lengths that take over what the model is stretched: the law beside `ShapeFeedback`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from apcc_torch.control.length_law import LawStep, LengthLaw, Memory
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.settings import OURS, Setting, Settings, aligned, resolved, setting


@dataclass(frozen=True, kw_only=True)
class ElongationLawSettings(Settings):
    """Settings of `ElongationLaw`."""

    time_constant: Setting = setting(
        0.3, "s", OURS, "in which the rest lengths take the elongations over", rows="number", above=0
    )


class ElongationLaw(LengthLaw):
    """pi_hat_dot = dL / tau: a section that the shape asks to be longer becomes so, and Psi falls to nothing.

    With `ShapeFeedback` the lengths l = pi + dL of the model's sections are those with which arcs follow the arm's
    shape best, drawn to the nominal ones as far as shape does not tell them. The law leaves l and the shape as they
    are: it moves what is elongation to where it belongs.

    Args:
        nominal: (..., n_b) m; not used.
        feedback: Algorithm 2; not used.
        *settings, **changes: See `ElongationLawSettings`.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> nominal = torch.tensor([0.2, 0.25]).double()
        >>> ElongationLaw(nominal, StateFeedback(PCCBackbone(2), nominal.cumsum(0)), time_constant=0.5)
        ElongationLaw(time_constant=0.5)
    """

    settings_type = ElongationLawSettings
    time_constant: Setting
    needs_velocity = False

    def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(ElongationLawSettings, settings, changes))

    def speed(self, step: LawStep, memory: Memory) -> tuple[Tensor, Memory]:
        """See `LengthLaw.speed`."""
        # Over a period longer than tau no more than all of it.
        tau = _at_least(aligned(self.time_constant, 1), step.dt.unsqueeze(-1))
        return step.q_bar[..., step.backbone.coordinates.elongations] / tau, memory


def _at_least(tau: Setting, dt: Tensor) -> Tensor:
    """The larger of a number or tensor and a tensor."""
    return dt.clamp(min=tau) if isinstance(tau, float | int) else dt.maximum(tau)
