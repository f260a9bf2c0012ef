"""Adaptation among several models: rest lengths side by side, and the best of them are followed.

What the sensors say of the rest lengths has valleys: along one of them, where one section takes what another gives, the
residual hardly changes, and a gradient that follows it comes to a stop early or in the wrong valley. A bank of models
knows no slopes. Each has rest lengths of its own and its own algorithm 2; pi_hat moves towards the best of them. It is
adaptation by multiple models (Narendra and Balakrishnan 1997), of a cost that feedback cannot hide.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import scaled_within, within
from apcc_torch.control.length_law import LawStep, LengthLaw
from apcc_torch.control.residual_adaptation import curve_of
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_curve import SensorCurveSettings
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import holds, none_left, values_of
from apcc_torch.part import hold_rows, refuse_parameter
from apcc_torch.settings import MANY, OURS, Setting, aligned, is_on, resolved, setting
from apcc_torch.shapes import check_finite, check_tensor
from apcc_torch.spread import is_profile

UNSEEN = 1.0
"""V of a model before its first visit, m^2: more than any arm can leave, and finite, so that gradients are."""

Shares = Sequence[float] | Sequence[Sequence[float]] | Sequence[Tensor]
"""What sections are tried with: one list for all but the last, or one for each of them, where (..., c) one a row."""


class BankEvidence(NamedTuple):
    """What is known of the M models.

    q: (..., M, n) their q_bar when last visited. cost: (..., M) their V, m^2; `UNSEEN` before the first visit.
    turn: (...) int64, the model that is visited next.
    """

    q: Tensor
    cost: Tensor
    turn: Tensor


@dataclass(frozen=True, kw_only=True)
class LengthBankSettings(SensorCurveSettings):
    """Settings of `LengthBank`."""

    shares: Shares | Tensor = setting(
        (0.4, 0.55, 0.7, 0.85, 1.0, 1.15),
        "",
        OURS,
        "lengths tried, over the nominal ones: one list, or one a section but the last, which takes the rest",
        rows="lists",
    )
    samples: int = setting(4, "", OURS, "points of the curve between two sensors", least=1, most=MANY)
    elongation_weight: Setting = setting(
        0.02, "", OURS, "mu, how much elongation weighs against distance", rows="number", least=0
    )
    nominal_weight: Setting = setting(0.002, "", OURS, "kappa, pull towards the first estimate", rows="number", least=0)
    sharpness: Setting = setting(
        0.3, "", OURS, "share by which a model may be worse than the best and still count", rows="number", least=0
    )
    resolution: Setting = setting(3e-5, "m", OURS, "distances that are alike", rows="number", above=0)
    memory: Setting = setting(
        2.0, "s", OURS, "over which a model's past costs count; 0: the last alone", rows="number", least=0, apart=True
    )
    time_constant: Setting = setting(
        1.0, "s", OURS, "in which a step of the rest lengths is made", rows="number", above=0
    )
    rate: Setting = setting(0.3, "m/s", OURS, "largest speed of a parameter", rows="number", above=0)
    stretch: Setting = setting(
        0.0,
        "",
        OURS,
        "how much of the model's compression the total length takes over",
        rows="number",
        least=0,
        apart=True,
    )
    total_range: Setting = setting(
        0.1, "", OURS, "how far the total length may fall, relative", rows="number", least=0, below=1
    )


class LengthBank(LengthLaw):
    """pi_hat_dot = (pi* - pi_hat) / tau, pi* the mean of the bank's rest lengths pi_m, weighed by

        w_m ~ exp(-(V_m - min V) / (sharpness min V + resolution^2)),
        V_m = |r_m|^2 / N + mu^2 |dL_m|^2 + kappa^2 |pi_m - pi_0|^2.

    r_m are the N distances, across the backbone, between model m and the `SensorCurve`; dL_m its elongations. The last
    section takes what the others leave of the total length. One model is visited a step, in turn: a step costs one more
    run of algorithm 2, whatever the size of the bank.

    The total length S of all models alike is a matter of its own: a longer model that is compressed and a shorter one
    that is not have nearly the same shape, so the sensors do not tell S, but the null-space term of Eq. (16) drives the
    arm to it. Of S_0, nominal, and S + sum dL, the model as it is stretched now, S goes towards

        S* = S_0 + gamma (S + sum dL - S_0), within [(1 - total_range) S_0, S_0],

    the minimum of gamma (S + sum dL - S*)^2 + (1 - gamma) (S* - S_0)^2. With gamma = 0 it stays nominal, with 1 the
    rest lengths take over what the model is compressed, and above 1 more of it. It never grows beyond S_0: the last
    sensor would no longer be on the tip.

    Each number may also be a tensor (...), one a row, but for a memory or stretch of zero, which all rows share.

    Args:
        nominal: (..., n_b) pi_0, m.
        feedback: Algorithm 2, of the controller's own settings.
        *settings, **changes: See `LengthBankSettings`.

    Raises:
        ConfigError: There are fewer sensors than sections, or no share but 1.
        ValueRangeError: A setting is out of range.

    Example:
        >>> nominal = torch.tensor([0.2, 0.25]).double()
        >>> bank = LengthBank(nominal, StateFeedback(PCCBackbone(2), nominal.cumsum(0)), shares=[0.8, 1.0, 1.2])
        >>> bank.candidates
        tensor([[0.2000, 0.2500],
                [0.1600, 0.2900],
                [0.2400, 0.2100]], dtype=torch.float64)
    """

    settings_type = LengthBankSettings
    needs_velocity = False
    nominal: Tensor
    candidates: Tensor
    many: Tensor
    elongation_weight: Setting
    nominal_weight: Setting
    sharpness: Setting
    resolution: Setting
    memory: Setting
    time_constant: Setting
    rate: Setting
    stretch: Setting
    total_range: Setting

    def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(LengthBankSettings, settings, changes)
        refuse_parameter("nominal", nominal, "the bank's models are made of it once; hand in a plain tensor")
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        self.feedback = feedback
        self.curve = curve_of(feedback, s)
        self.hold(s)
        with nominal.device:  # where numbers become tensors
            models = candidates(nominal, lists_of(s.shares, nominal.shape[-1] - 1), feedback.abscissae)
        # How many are a row's own: the others repeat the first. A row is the same in any batch.
        own = 1 + (models[..., 1:, :] != models[..., :1, :]).any(-1).sum(-1)
        hold_rows(self, nominal=(nominal, 1), candidates=(models, 2), many=(own, 0))

    def _hold_one(self, name: str, value: Any, trailing: int) -> None:
        # The shares make the candidates; they are no tensor of the computation.
        if name == "shares":
            setattr(self, name, value)
        else:
            super()._hold_one(name, value, trailing)

    def initial_memory(self, q: Tensor, pi_hat: Tensor) -> BankEvidence:
        """Nothing known yet, of the batch of q (..., n) and pi_hat (..., n_b); every model starts from q."""
        M = self.candidates.shape[-2]
        batch = torch.broadcast_shapes(q.shape[:-1], pi_hat.shape[:-1])
        cost = torch.full((*batch, M), UNSEEN, dtype=q.dtype, device=q.device)
        turn = torch.zeros(batch, dtype=torch.int64, device=q.device)
        return BankEvidence(q.unsqueeze(-2).expand(*batch, M, q.shape[-1]), cost, turn)

    def speed(self, step: LawStep, memory: BankEvidence) -> tuple[Tensor, BankEvidence]:
        """See `LengthLaw.speed`; rows not all of whose sensors count, or that are not finite, stay.

        Visits one model. The models have their own q_bar; the total length follows the elongations of the controller's.
        """
        backbone, pi, T, evidence = step.backbone, step.pi_hat, step.T, memory
        complete = step.complete(self.curve.tangents == "measured")
        M = self.candidates.shape[-2]
        total = self._total(pi)
        models = self.candidates.to(pi).expand(*pi.shape[:-1], M, pi.shape[-1])
        if is_on(self.stretch):
            models = models * total.unsqueeze(-1)
        chosen = torch.arange(M, device=pi.device) == evidence.turn.unsqueeze(-1)
        visited = torch.where(chosen.unsqueeze(-1), models, 0.0).sum(-2)
        seed = torch.where(chosen.unsqueeze(-1), evidence.q, 0.0).sum(-2)
        q_m = self.feedback(seed, visited, T).q_bar
        V = self.cost(backbone, q_m, visited, T)
        if is_on(self.memory):
            before = torch.where(chosen, evidence.cost, 0.0).sum(-1)
            V = torch.where(
                before < UNSEEN, torch.lerp(V, before, torch.exp(-self.many.to(pi) * step.dt / self.memory)), V
            )
        good = complete & torch.isfinite(V)
        new = chosen & good.unsqueeze(-1)
        later = BankEvidence(
            torch.where(new.unsqueeze(-1), q_m.unsqueeze(-2), evidence.q),
            torch.where(new, V.unsqueeze(-1), evidence.cost),
            torch.where(complete, torch.where(evidence.turn + 1 < self.many, evidence.turn + 1, 0), evidence.turn),
        )
        low = later.cost.amin(-1, keepdim=True)
        sharpness, resolution = aligned(self.sharpness, 1), aligned(self.resolution, 1)
        weight = torch.exp((low - later.cost) / (sharpness * low + resolution**2)).unsqueeze(-1)
        weight = torch.where((torch.arange(M, device=pi.device) < self.many.unsqueeze(-1)).unsqueeze(-1), weight, 0.0)
        best = (weight * models).sum(-2) / weight.sum(-2)
        if is_on(self.stretch):
            stretched = self._total(pi + step.q_bar[..., backbone.coordinates.elongations])
            shorter = (aligned(self.stretch, 1) * (stretched - 1.0)).clamp(max=0.0)
            change = within(shorter, self.total_range)
            best = best * (1.0 + change) / total
        velocity = scaled_within((best - pi) / aligned(self.time_constant, 1), self.rate)
        return torch.where(good.unsqueeze(-1) & torch.isfinite(velocity), velocity, 0.0), later

    def cost(self, backbone: KinematicModel, q: Tensor, pi: Tensor, T: Tensor) -> Tensor:
        """V (...), m^2, of rest lengths pi (..., n_b) at q (..., n), poses T (..., k, 4, 4); unchecked."""
        # Of a model of another total length, the points that are as far along it.
        X = self.curve.abscissae.to(pi) * self._total(pi)
        off = self.curve.across(backbone.chain_to(q, backbone.material_points(pi, *located(X, pi))), T)
        dL = q[..., backbone.coordinates.elongations]
        away = pi - self.nominal.to(pi)
        prior = self.elongation_weight**2 * dL.square().sum(-1) + self.nominal_weight**2 * away.square().sum(-1)
        return off.square().mean((-1, -2)) + prior

    def _total(self, lengths: Tensor) -> Tensor:
        """(..., 1) the total of lengths (..., n_b), relative to the nominal one."""
        return lengths.sum(-1, keepdim=True) / self.nominal.to(lengths).sum(-1, keepdim=True)


def candidates(nominal: Tensor, lists: Sequence[Tensor], abscissae: Tensor) -> Tensor:
    """(..., M, n_b) rest lengths, m: the nominal ones, then every combination of shares of all sections but the last.

    M is that of the row with most; a row with fewer has the nominal ones again behind its own.

    Left out are those with no length for the last section, and those that the sensors cannot tell: for every section
    there must be a sensor of its own in it or in the next one, as a spline needs a point for every knot (the condition
    of Schoenberg and Whitney). Otherwise one section is bent at will and its neighbour unbends it. Where nothing else
    is left the nominal lengths are, and pi_hat stays there.

    Args:
        nominal: (..., n_b) m.
        lists: Shares of each section but the last, relative to its nominal length, from `lists_of`.
        abscissae: (..., k) of the sensors, m, increasing.

    Raises:
        ConfigError: There are fewer sensors than sections, one section alone, or no share but 1.
    """
    n_b, k = nominal.shape[-1], abscissae.shape[-1]
    if k < n_b:
        raise ConfigError(f"a bank of models with {n_b} sections needs at least {n_b} sensors, got {k}")
    combinations = itertools.product(*(each.unbind(-1) for each in lists)) if lists else ()
    every = (torch.stack(torch.broadcast_tensors(*factors), dim=-1) for factors in combinations)
    others = [factors.to(nominal) for factors in every if not none_left(factors != 1.0)]
    if not others:
        raise ConfigError(f"a bank needs two sections or more and shares other than 1, got {n_b} sections")
    combined = torch.stack(others, dim=-2)
    first = nominal.unsqueeze(-2)[..., :-1] * combined
    last = nominal.sum(-1)[..., None, None] - first.sum(-1, keepdim=True)
    made = torch.cat((first, last.expand(*first.shape[:-1], 1)), dim=-1)
    kept = (made[..., -1] > 0) & _told_apart(made, abscissae.to(nominal).unsqueeze(-2))
    # Each row's own come first, in their order; behind them stand the nominal ones, once more.
    nominal = nominal.unsqueeze(-2)
    kept = kept & (made != nominal).any(-1)
    made = torch.where(kept.unsqueeze(-1), made, nominal)
    order = (~kept).to(torch.uint8).argsort(dim=-1, stable=True)
    made = made.gather(-2, order.unsqueeze(-1).expand(*order.shape, n_b))
    most = values_of(kept.sum(-1).amax())
    if most is not None:  # else nothing is known of them, and all stay
        made = made[..., :most, :]
    return torch.cat((nominal.expand(*made.shape[:-2], 1, n_b), made), dim=-2)


def lists_of(shares: Shares | Tensor, sections: int) -> list[Tensor]:
    """The shares (..., c) of each of `sections` sections; of several runs (P, 1, c), or (P, sections, c) of lists.

    Raises:
        ValueRangeError: A share is not positive and finite, or there are not as many lists as sections but the last.
    """
    if isinstance(shares, Tensor):
        rows = list(shares.split(1, dim=-2))
        return rows * sections if len(rows) == 1 else rows
    entries: list[Any] = list(shares)
    if is_profile(entries):
        # Each section takes the list of its place along the arm.
        profile, m = entries[1:], len(entries) - 1
        entries = [profile[min((2 * i + 1) * m // (2 * sections), m - 1)] for i in range(sections if m else 0)]
    own = [entry for entry in entries if isinstance(entry, list | tuple | Tensor)]
    alike = [entry for entry in entries if not isinstance(entry, list | tuple | Tensor)]
    if own and (alike or len(own) != sections):
        raise ValueRangeError(f"shares must be one list of numbers, or {sections} lists, got {shares}")
    every = own or [alike] * sections
    listed = [share for group in every if not isinstance(group, Tensor) for share in group]
    if all(isinstance(share, int | float) for share in listed):
        lists = [torch.as_tensor(group, dtype=torch.float64) for group in every]
        if all(group.numel() > 0 and holds((group > 0) & torch.isfinite(group)) for group in lists):
            return lists
    raise ValueRangeError(f"shares must be positive and finite numbers, at least one, got {shares}")


def _told_apart(lengths: Tensor, abscissae: Tensor) -> Tensor:
    """(...) whether sensors at `abscissae` (..., k) tell the sections of `lengths` (..., n_b) from each other."""
    n_b, k = lengths.shape[-1], abscissae.shape[-1]
    ends = torch.nn.functional.pad(lengths.cumsum(-1), (1, 1))
    ends[..., -1] = float("inf")  # nothing follows the last section
    told = lengths.new_zeros(torch.broadcast_shapes(lengths.shape[:-1], abscissae.shape[:-1]), dtype=torch.bool)
    for chosen in itertools.combinations(range(k), n_b):
        X = abscissae[..., list(chosen)]
        told = told | ((ends[..., :n_b] < X) & (ends[..., 2:] > X)).all(-1)
    return told
