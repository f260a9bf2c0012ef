"""Model predictive path integral control: ways sampled around Eq. (16), rolled out, and averaged by what they cost.

Every way is the controller's own loop with a departure from it. Departures whose ways cost little count most in the
mean, w = exp(-(cost - least) / lambda), and the mean is where the next samples begin. Williams et al.: Information
theoretic MPC for model-based reinforcement learning, ICRA 2017.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.ahead import AheadStatus
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.control.predicted_loop import Outlook, Predicted, PredictedLoop
from apcc_torch.native.compiled import Step, TorchStep
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import resolved


class Way(NamedTuple):
    """A departure from Eq. (16).

    knots: (..., k, 3 + n). status: (...) `AheadStatus`. cost: (...) of it, and alone: (...) of none.
    """

    knots: Tensor
    status: Tensor
    cost: Tensor
    alone: Tensor


class Lookahead(Part):
    """The departure from Eq. (16) for an arm now.

    The first sample departs not at all and the second as the mean of before did. The mean is rolled out too, and
    dropped where it costs more than no departure: what is returned never costs more than Eq. (16) in its own model.
    Half of the others differ in the tip's velocity alone. Samples come from sets that are drawn once and taken in turn:
    the same arms in the same state get the same way, alone and in a batch.

    Args:
        loop: Its model.
        *settings, **changes: See `LookaheadSettings`; those of the model are the loop's.

    Example:
        >>> controller = LookaheadController.for_arm(
        ...     Arm(lengths=[0.2, 0.25], mass=0.4), adaptation=None, lookahead=LookaheadSettings(samples=64)
        ... )
        >>> controller.lookahead.noise.shape  # sets, samples, knots, of tip and configuration
        torch.Size([16, 64, 3, 9])
    """

    settings_type = LookaheadSettings
    samples: int
    knots: int
    tip_spread: float
    tip_floor: float
    bend_spread: float
    length_spread: float
    temperature: float
    batch: int
    seed: int
    noise: Tensor

    def __init__(self, loop: PredictedLoop, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(LookaheadSettings, settings, changes)
        self.loop = loop
        self.hold(s)
        like = loop.dynamics.lengths
        generator = torch.Generator("cpu").manual_seed(s.seed)
        shape = (s.batch, s.samples, s.knots, 3 + loop.backbone.n)
        noise = torch.randn(shape, generator=generator, dtype=torch.float64, device="cpu")
        noise[:, ::2, :, 3:] = 0.0
        noise[:, 1] = 0.0
        hold_rows(self, noise=(noise.to(like), 4))

    def shifted(self, knots: Tensor, time: Tensor) -> Tensor:
        """Knots (..., k, 3 + n) as they are seen a time (...) s later."""
        last = knots.shape[-2] - 1
        each = torch.arange(last + 1, dtype=knots.dtype, device=knots.device) / max(last, 1) * self.loop.horizon
        return self.loop.departure(knots.unsqueeze(-3), time.unsqueeze(-1) + each)

    def sampled(self, mean: Tensor, speed: Tensor, number: Tensor) -> Tensor:
        """Knots (..., S, k, 3 + n) around a mean (..., k, 3 + n).

        Args:
            mean: The first samples' mean.
            speed: (...) m/s that Eq. (16) asks of the tip.
            number: (...) int64, which set of samples is next.
        """
        coordinates = self.loop.backbone.coordinates
        free = coordinates.per_unit(self.bend_spread, self.length_spread, self.loop.backbone.n, mean)
        tip = (self.tip_floor + self.tip_spread * speed).unsqueeze(-1).expand(*speed.shape, 3)
        spread = torch.cat((tip, free.expand(*speed.shape, free.shape[-1])), dim=-1)
        noise = self.noise.index_select(0, (number % self.batch).flatten()).reshape(
            *number.shape, *self.noise.shape[1:]
        )
        knots = mean.unsqueeze(-3) + spread[..., None, None, :] * noise
        first = torch.zeros_like(knots[..., :1, :, :])
        return torch.cat((first, knots[..., 1:, :, :]), dim=-3)

    def cost(self, now: Predicted, knots: Tensor, outlook: Outlook, run: Step) -> Tensor:
        """What ways (..., S) cost, infinite where they are not finite.

        Args:
            now: (...) the arms.
            knots: (..., S, k, 3 + n).
            outlook: (...) what is known and wanted.
            run: The loop's steps.
        """
        start, known = (
            type(each)(*[value.unsqueeze(len(now.cost.shape)) for value in each]) for each in (now, outlook)
        )
        start = Predicted(*[value.expand(*knots.shape[:-2], *value.shape[now.cost.dim() + 1 :]) for value in start])
        cost = run(start, knots, known, repeats=self.loop.steps + 1).cost
        return torch.where(torch.isfinite(cost), cost, torch.inf)

    def forward(self, now: Predicted, outlook: Outlook, mean: Tensor, number: Tensor, run: Step | None = None) -> Way:
        """The way to take.

        Args:
            now: (...) the arms, of one leading shape.
            outlook: (...) what is known and wanted of them.
            mean: (..., k, 3 + n) departure to begin with.
            number: (...) int64, how many ways were looked for before.
            run: The steps of `loop`; None for itself, eagerly.
        """
        run = TorchStep(self.loop) if run is None else run
        wanted = self.loop.inverse_kinematics.tip_velocity(now.e + outlook.z, outlook.xdot_d)
        knots = self.sampled(mean, torch.linalg.vector_norm(wanted, dim=-1), number)
        cost = self.cost(now, knots, outlook, run)
        alone = cost[..., 0]
        middle = mean_of(knots, cost, self.temperature)
        own = self.cost(now, middle.unsqueeze(-3), outlook, run)[..., 0]
        status = torch.where(own < alone, int(AheadStatus.FOLLOWED), int(AheadStatus.NOT_BETTER))
        status = torch.where(torch.isfinite(alone) | torch.isfinite(own), status, int(AheadStatus.NOT_FINITE))
        followed = (status == int(AheadStatus.FOLLOWED))[..., None, None]
        return Way(torch.where(followed, middle, 0.0), status, torch.minimum(own, alone), alone)


def mean_of(knots: Tensor, cost: Tensor, temperature: float) -> Tensor:
    """Mean (..., k, m) of knots (..., S, k, m) with weights exp(-(cost - least) / lambda), lambda the temperature times
    how far the costs (..., S) are above the least in the mean; samples of infinite cost do not count.

    Example:
        >>> mean_of(torch.tensor([[[1.0]], [[3.0]]]), torch.tensor([2.0, 2.0]), 0.1)
        tensor([[2.]])
    """
    finite = torch.isfinite(cost)
    least = cost.amin(-1, keepdim=True)
    above = torch.where(finite, cost - least, 0.0)
    scale = temperature * above.sum(-1, keepdim=True) / finite.sum(-1, keepdim=True).clamp(min=1)
    weights = torch.where(finite, torch.exp(-above / scale.clamp(min=torch.finfo(cost.dtype).tiny)), 0.0)
    weights = weights / weights.sum(-1, keepdim=True).clamp(min=torch.finfo(cost.dtype).tiny)
    return (weights[..., None, None] * knots).sum(-3)
