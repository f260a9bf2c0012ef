"""A contact somewhere along the arm: how large it is, and where, as far as the balance of forces tells.

A force at X moves the sections up to X and no other, so its place shows in which equations it disturbs. For every
abscissa the best force is a linear problem; the place is the abscissa whose force leaves least.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.external_force import ForceBalance, Tare
from apcc_torch.estimation.posture import Posture
from apcc_torch.estimation.weighted_estimate import EstimateStatus, WeightedEstimate, weighted_estimate
from apcc_torch.part import Part

# Three components of the force, and its place.
UNKNOWNS = 4
# 95 % of a chi-square variable of one degree of freedom.
ONE_OF_TWENTY = 3.84


class Contact(NamedTuple):
    """What touches the arm.

    estimate: The force (..., 3) at `abscissa`, world axes, N, as if the place were known.
    abscissa: (...) the place whose force leaves the least misfit, m.
    interval: (..., 2) first and last place whose misfit is not worse by `ONE_OF_TWENTY`, m; where even the best place
        leaves more than the noise explains, in units of what it leaves.
    located: (...) bool, the interval is short enough.
    evidence: (...) misfit without any force less the least one: how sure it is that there is a contact.
    gain: (...) misfit with the force at the tip less the least one: how sure it is that it is not there.
    """

    estimate: WeightedEstimate
    abscissa: Tensor
    interval: Tensor
    located: Tensor
    evidence: Tensor
    gain: Tensor


class ContactSearch(Part):
    """Finds a contact force at an unknown abscissa.

    Args:
        balance: The balance of forces.
        candidates: Abscissae that are tried, evenly over the arm; the best is then refined between its neighbours.
        refinements: Times that the grid is laid anew between the best place's neighbours.
        nearest: First abscissa that is tried, m: a force near the base moves nothing.
        longest: Length of the interval up to which a place counts as located, m.

    Raises:
        ConfigError: The model has too few coordinates to tell a force and its place.
        ValueRangeError: A number is out of range.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.45)
        >>> body = StaticBody(arm.backbone(), density=1.0, axial=10.0, bending=0.0778)
        >>> balance = ForceBalance(body, arm.routing(), StateFeedback(arm.backbone(), arm.sensor_places()))
        >>> u = torch.zeros(6).double()
        >>> pushed = Loads(wrench=torch.tensor([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]).double())
        >>> posture = Posture(equilibrium(arm.dynamics(), loads=pushed).q, arm.rest_lengths(), u)
        >>> ContactSearch(balance)(posture).abscissa
        tensor(0.4500, dtype=torch.float64)
    """

    shares: Tensor

    def __init__(
        self,
        balance: ForceBalance,
        candidates: int = 41,
        refinements: int = 2,
        nearest: float = 0.05,
        longest: float = 0.1,
    ) -> None:
        super().__init__()
        if candidates < 3 or refinements < 0:
            raise ValueRangeError(
                f"candidates must be at least 3 and refinements at least 0, got {candidates} and {refinements}"
            )
        if not (nearest > 0.0 and longest > 0.0):
            raise ValueRangeError(f"nearest and longest must be positive, got {nearest:g} and {longest:g}")
        if balance.body.backbone.n <= UNKNOWNS:
            raise ConfigError(
                f"a force and its place are {UNKNOWNS} unknowns; the model has {balance.body.backbone.n} coordinates"
            )
        self.balance = balance
        self.refinements = refinements
        self.nearest = nearest
        self.longest = longest
        self.candidates = candidates
        self.derive()

    def derive(self) -> None:
        """Where on the arm the abscissae that are tried lie."""
        device = self.balance.feedback.abscissae.device
        shares = torch.linspace(0.0, 1.0, self.candidates, dtype=torch.float64, device=device)
        self.register_buffer("shares", shares, persistent=False)

    def forward(
        self, posture: Posture, tare: Tare | None = None, mask: Tensor | None = None, angular_mask: Tensor | None = None
    ) -> Contact:
        """The contact of each row.

        Args:
            posture: The arm.
            tare: From the unloaded arm; None for none.
            mask, angular_mask: (..., k) bool, as in `StateFeedback.forward`.
        """
        balance = self.balance
        dtype = posture.q_bar.dtype
        exact = posture.double()
        r = balance.imbalance(exact, None if tare is None else tare.offset)
        tip = balance.tip.to(r)
        grid = self.nearest + (tip - self.nearest) * self.shares.to(r)
        S = balance.covariance(exact, tare=tare, mask=mask, angular_mask=angular_mask)
        first, place = self._search(exact, r, S, grid)
        # Once more with the noise that the force itself brings in: its lever moves with the arm.
        first = torch.where(torch.isfinite(first), first, 0.0)
        S = balance.covariance(exact, place.unsqueeze(-1), first, tare, mask, angular_mask)
        _, place = self._search(exact, r, S, grid)
        axes = torch.eye(3, dtype=r.dtype, device=r.device)
        Phi = balance.columns(exact, place.unsqueeze(-1), axes)[..., 0, :, :]
        best = weighted_estimate(r, Phi, S, self._limit(r))
        # The whole arm, for places that are far and as good, and finely around the best one.
        step = grid[..., 1:2] - grid[..., :1]
        around = (place.unsqueeze(-1) + step * (2.0 * self.shares.to(r) - 1.0)).clamp(min=0.0)
        places = torch.cat((torch.minimum(around, tip), grid.expand(around.shape)), dim=-1)
        along = self._at(exact, r, S, places).misfit
        excess = best.misfit / (r.shape[-1] - UNKNOWNS)
        near = along <= (best.misfit + ONE_OF_TWENTY * excess.clamp(min=1.0)).unsqueeze(-1)
        low = torch.where(near, places, place.unsqueeze(-1)).amin(-1)
        high = torch.where(near, places, place.unsqueeze(-1)).amax(-1)
        none = (r * torch.linalg.solve_ex(S, r.unsqueeze(-1))[0].squeeze(-1)).sum(-1)
        interval = torch.stack((low, high), dim=-1)
        located = (high - low <= self.longest) & (best.status == int(EstimateStatus.DETERMINED))
        evidence, gain = (worse - best.misfit for worse in (none, along[..., -1]))
        return Contact(
            best.to(dtype), place.to(dtype), interval.to(dtype), located, evidence.to(dtype), gain.to(dtype)
        )  # fmt: skip

    def _search(self, posture: Posture, r: Tensor, S: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
        """Force (..., 3) and abscissa (...) of the least misfit."""
        low, high = grid[..., :1], grid[..., -1:]
        places = grid
        for k in range(self.refinements + 1):
            result = self._at(posture, r, S, places)
            misfit = torch.where(torch.isfinite(result.misfit), result.misfit, torch.inf)
            index = misfit.argmin(-1, keepdim=True)
            places = places.expand(misfit.shape)
            place = torch.gather(places, -1, index)
            if k < self.refinements:
                step = places[..., 1:2] - places[..., :1]
                start, end = torch.maximum(place - step, low), torch.minimum(place + step, high)
                places = start + (end - start) * self.shares.to(r)
        force = torch.gather(result.value, -2, index.unsqueeze(-1).expand(*index.shape, 3))
        return force.squeeze(-2), place.squeeze(-1)

    def _at(self, posture: Posture, r: Tensor, S: Tensor, X: Tensor) -> WeightedEstimate:
        """The best force at each of the abscissae X (..., k)."""
        axes = torch.eye(3, dtype=r.dtype, device=r.device)
        Phi = self.balance.columns(posture, X, axes)
        return weighted_estimate(r.unsqueeze(-2), Phi, S.unsqueeze(-3), self._limit(r))

    def _limit(self, like: Tensor) -> Tensor:
        return torch.full((3,), self.balance.limit, dtype=like.dtype, device=like.device)
