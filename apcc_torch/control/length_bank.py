"""Adaptation among several models: rest lengths side by side, and the best of them are followed.

What the sensors say of the rest lengths has valleys: along one of them, where one section takes what another gives, the
residual hardly changes, and a gradient that follows it comes to a stop early or in the wrong valley. A bank of models
knows no slopes. Each has rest lengths of its own and its own algorithm 2; pi_hat moves towards the best of them. It is
adaptation by multiple models (Narendra and Balakrishnan 1997), of a cost that feedback cannot hide.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import scaled_within, within
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import holds, none_left, values_of
from apcc_torch.part import Part, check_settings, check_settings_or_zero, hold, hold_rows, refuse_parameter
from apcc_torch.settings import Setting, aligned, is_used, numbers_in
from apcc_torch.shapes import check_finite, check_tensor

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


class LengthBank(Part):
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
        curve: Through the sensors.
        shares: What the sections but the last are tried with, relative to their nominal lengths: one list for all, or
            one a section; see `candidates`.
        elongation_weight: mu.
        nominal_weight: kappa.
        sharpness: The share by which V may exceed the least and still count.
        resolution: m, distances that are alike.
        memory: s over which a model's past V count; 0 for the last alone.
        time_constant: tau, s.
        rate: Largest speed of a parameter, m/s. A row over it is scaled whole.
        stretch: gamma.
        total_range: How far the total length may fall below the nominal one, relative to it; below 1.

    Raises:
        ConfigError: There are fewer sensors than sections, or no combination of shares is left.
        ValueRangeError: A setting is out of range.
    """

    nominal: Tensor
    candidates: Tensor
    elongation_weight: Setting
    nominal_weight: Setting
    sharpness: Setting
    resolution: Setting
    memory: Setting
    time_constant: Setting
    rate: Setting
    stretch: Setting
    total_range: Setting
    needs_sensitivity = False

    def __init__(
        self,
        nominal: Tensor,
        feedback: StateFeedback,
        curve: SensorCurve,
        shares: Shares = (0.4, 0.55, 0.7, 0.85, 1.0, 1.15),
        elongation_weight: Setting = 0.02,
        nominal_weight: Setting = 0.002,
        sharpness: Setting = 0.3,
        resolution: Setting = 3e-5,
        memory: Setting = 2.0,
        time_constant: Setting = 1.0,
        rate: Setting = 0.3,
        stretch: Setting = 0.0,
        total_range: Setting = 0.1,
    ) -> None:
        super().__init__()
        positive = {"time_constant": time_constant, "rate": rate, "resolution": resolution}
        weights = {
            "elongation_weight": elongation_weight,
            "nominal_weight": nominal_weight,
            "sharpness": sharpness,
            "memory": memory,
            "stretch": stretch,
            "total_range": total_range,
        }
        check_settings(**positive)
        check_settings_or_zero(**weights)
        if any(number >= 1 for number in numbers_in(total_range)):
            raise ValueRangeError(f"total_range must be below 1, got {total_range}")
        refuse_parameter("nominal", nominal, "the bank's models are made of it once; hand in a plain tensor")
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        self.feedback = feedback
        self.curve = curve
        hold(self, **positive, **weights)
        self.remembers, self.stretches = is_used(memory), is_used(stretch)
        hold_rows(self, nominal=(nominal, 1), candidates=(candidates(nominal, shares, feedback.abscissae), 2))

    @property
    def needs_orientations(self) -> bool:
        """Whether the cost is made of measured orientations too."""
        return self.curve.tangents == "measured"

    def initial_evidence(self, q: Tensor, pi_hat: Tensor) -> BankEvidence:
        """Nothing known yet, of the batch of q (..., n) and pi_hat (..., n_b); every model starts from q."""
        M = self.candidates.shape[-2]
        batch = torch.broadcast_shapes(q.shape[:-1], pi_hat.shape[:-1])
        cost = torch.full((*batch, M), UNSEEN, dtype=q.dtype, device=q.device)
        turn = torch.zeros(batch, dtype=torch.int64, device=q.device)
        return BankEvidence(q.unsqueeze(-2).expand(*batch, M, q.shape[-1]), cost, turn)

    def forward(
        self,
        backbone: KinematicModel,
        q: Tensor,
        pi: Tensor,
        followed: Tensor | None,
        T: Tensor,
        abscissae: Tensor,
        dt: Tensor,
        seen: Tensor,
        evidence: BankEvidence,
    ) -> tuple[Tensor, BankEvidence]:
        """pi_hat_dot (..., n_b), m/s, and the evidence after this visit; rows that are not seen or not finite stay.

        Args:
            backbone: The model.
            q: (..., n) q_bar, whose elongations the total length follows.
            followed, abscissae: Not used: the models of the bank have their own.
            pi: (..., n_b) pi_hat, m.
            T: (..., k, 4, 4) measured poses.
            dt: (...) s since the last sample.
            seen: (...) bool, rows all of whose sensors count.
            evidence: From `initial_evidence` or the last step.
        """
        M = self.candidates.shape[-2]
        total = self._total(pi)
        models = self.candidates.to(pi).expand(*pi.shape[:-1], M, pi.shape[-1])
        if self.stretches:
            models = models * total.unsqueeze(-1)
        chosen = torch.arange(M, device=pi.device) == evidence.turn.unsqueeze(-1)
        visited = torch.where(chosen.unsqueeze(-1), models, 0.0).sum(-2)
        seed = torch.where(chosen.unsqueeze(-1), evidence.q, 0.0).sum(-2)
        q_m = self.feedback(seed, visited, T).q_bar
        V = self.cost(backbone, q_m, visited, T)
        if self.remembers:
            before = torch.where(chosen, evidence.cost, 0.0).sum(-1)
            V = torch.where(before < UNSEEN, torch.lerp(V, before, torch.exp(-M * dt / self.memory)), V)
        good = seen & torch.isfinite(V)
        new = chosen & good.unsqueeze(-1)
        later = BankEvidence(
            torch.where(new.unsqueeze(-1), q_m.unsqueeze(-2), evidence.q),
            torch.where(new, V.unsqueeze(-1), evidence.cost),
            torch.where(seen, torch.where(evidence.turn + 1 < M, evidence.turn + 1, 0), evidence.turn),
        )
        low = later.cost.amin(-1, keepdim=True)
        sharpness, resolution = aligned(self.sharpness, 1), aligned(self.resolution, 1)
        weight = torch.exp((low - later.cost) / (sharpness * low + resolution**2)).unsqueeze(-1)
        best = (weight * models).sum(-2) / weight.sum(-2)
        if self.stretches:
            stretched = self._total(pi + q[..., backbone.coordinates.elongations])
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


def candidates(nominal: Tensor, shares: Shares, abscissae: Tensor) -> Tensor:
    """(..., M, n_b) rest lengths, m: the nominal ones, then every combination of shares of all sections but the last.

    Left out are those with no length for the last section, and those that the sensors cannot tell: for every section
    there must be a sensor of its own in it or in the next one, as a spline needs a point for every knot (the condition
    of Schoenberg and Whitney). Otherwise one section is bent at will and its neighbour unbends it.

    Args:
        nominal: (..., n_b) m.
        shares: Relative to a section's nominal length.
        abscissae: (..., k) of the sensors, m, increasing.

    Raises:
        ConfigError: There are fewer sensors than sections or one section alone, or no combination is left.
        ValueRangeError: A share is not positive and finite, or there are not as many lists as sections but the last.
    """
    n_b, k = nominal.shape[-1], abscissae.shape[-1]
    if k < n_b:
        raise ConfigError(f"a bank of models with {n_b} sections needs at least {n_b} sensors, got {k}")
    lists = _lists(shares, n_b - 1)
    combinations = itertools.product(*(each.unbind(-1) for each in lists)) if lists else ()
    every = (torch.stack(torch.broadcast_tensors(*factors), dim=-1) for factors in combinations)
    others = [factors.to(nominal) for factors in every if not none_left(factors != 1.0)]
    if not others:
        raise ConfigError(f"a bank needs two sections or more and shares other than 1, got {n_b} and {list(shares)}")
    combined = torch.stack(others, dim=-2)
    first = nominal.unsqueeze(-2)[..., :-1] * combined
    last = nominal.sum(-1)[..., None, None] - first.sum(-1, keepdim=True)
    made = torch.cat((first, last.expand(*first.shape[:-1], 1)), dim=-1)
    kept = (made[..., -1] > 0) & _told_apart(made, abscissae.to(nominal).unsqueeze(-2))
    kept = kept.reshape(-1, kept.shape[-1]).all(0)  # in every row, for rows share the number of models
    if none_left(kept):
        raise ConfigError(f"shares must leave lengths that the sensors can tell, got {list(shares)}")
    places = values_of(kept)
    if places is not None:  # else nothing is known of them, and all stay
        made = made[..., places, :]
    return torch.cat((nominal.unsqueeze(-2).expand(*made.shape[:-2], 1, n_b), made), dim=-2)


def _lists(shares: Shares, sections: int) -> list[Tensor]:
    """The shares (..., c) of each of the sections."""
    own = [entry for entry in shares if isinstance(entry, list | tuple | Tensor)]
    alike = [entry for entry in shares if not isinstance(entry, list | tuple | Tensor)]
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
