"""An arm at rest under elastic tendons that can go slack: from what drives the tendons to where the bodies are.

The equilibrium is K (q - q_rest) + B T(q) = G(q), with the tension of a tendon T = k max(stretch, 0) and its stretch
the sum of what the actuator pulled, the stretch at the start (pre-tension) and y = B^T q. Capstan friction takes its
share of T on the way from the motor, by the direction in which the tendon last moved. Inputs act with a lag, the
damping ratio, as damping D = damping_ratio K makes a slow arm follow its equilibrium. A payload hangs at the tip.
Where inputs set tensions, T is what they say.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.identification.parameters import Values
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple, whole
from apcc_torch.model.arc import arc_geometry
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.friction import elastic_tension, tension_share
from apcc_torch.model.tendons import full_rows
from apcc_torch.spread import spread

_NODES = ((0.1127016653792583, 5 / 18), (0.5, 8 / 18), (0.8872983346207417, 5 / 18))
"""Gauss points of a section, and their shares of its mass."""
TIP_MASS = "tip_mass"
"""The block of a payload at the tip, (1,) kg, which no arm's file holds; without it there is none."""
_STEP = 1e-7
"""Step of the differences, rad and m: well inside the corner."""
_SETTLED = 1e-18
"""At rest where the unbalanced force would store less than this share of the arm's elastic energy..."""
_LEAST = 1e-6
"""...or of this energy, J, where the arm is straight."""
_FALLS = 1e-2
"""A slope serves the next step too where the last one brought this energy down to such a share: slopes cost most."""


class Drive(NamedTuple):
    """What drives an arm at N moments.

    history: (N, W, m) inputs, the newest first; W is one where the past does not matter.
    ages: (N, W) how long ago each was read, s, the first zero.
    slide: (N, m) the direction each input last moved in, from -1 to 1.
    """

    history: Tensor
    ages: Tensor
    slide: Tensor

    def rows(self, index: Tensor | slice) -> Drive:
        """Some of the moments."""
        return Drive(self.history[index], self.ages[index], self.slide[index])


class TendonArm:
    """Predicts the bodies of an arm; `values` are those of the blocks that `arm_parameters` names.

    Of the arm's description it takes what no block holds: the sections' masses, which input drives which tendon, and
    where in the sections tendons end and sensors sit.

    Args:
        arm: The arm.
        kinematic: Take the bends from the tendons' lengths alone, by the pseudo-inverse of B^T, as a PCC model does
            that knows no forces: tendons then push as well as pull.
    """

    def __init__(self, arm: Arm, kinematic: bool = False) -> None:
        if arm.chambers is not None:
            raise ConfigError("the fit knows arms on tendons: arm.chambers must be null")
        self.kinematic = kinematic
        lengths = arm.rest_lengths()
        self.backbone = PCCBackbone(arm.n_sections, torch.eye(3, dtype=lengths.dtype))
        self.fractions = arm.routing().fractions(lengths)
        self.inputs = list(arm.actuation.driving(arm.n_tendons))
        self.forced = arm.actuation.sets == "tension"
        self.pulls = spread("pulls", arm.actuation.pulls, arm.n_tendons)
        self.masses = arm.section_masses()
        X_tilde, self.section = decouple(arm.sensor_places(), lengths)
        self.X_tilde = whole(X_tilde)
        self.at_tips = bool((self.X_tilde == 1.0).all())
        points, weights = zip(*_NODES, (1.0, 0.0), strict=True)  # the last is the section's tip
        self._nodes, self._weights = (torch.tensor(numbers, dtype=lengths.dtype) for numbers in (points, weights))

    def matrix(self, values: Values) -> Tensor:
        """B (3 n_b, n_a)."""
        rows = full_rows(values["angle"], values["offset"])
        return (self.fractions.unsqueeze(-2) * rows).flatten(-3, -2)

    def pulled(self, drive: Drive, values: Values) -> Tensor:
        """What pulls each tendon at its motor (N, n_a): m, with the stretch it started with; or its tension, N."""
        if drive.ages.shape[-1] == 1:
            return self._pulled(drive.history[:, 0], values)
        edges = torch.exp(-drive.ages / values["damping_ratio"])
        # What an input read that long ago still weighs in a first-order lag; the oldest takes all before it.
        weights = edges - torch.nn.functional.pad(edges[:, 1:], (0, 1))
        return self._pulled((weights.unsqueeze(-1) * drive.history).sum(-2), values)

    def _pulled(self, inputs: Tensor, values: Values) -> Tensor:
        pulled = inputs[:, self.inputs] * self.pulls * values["input_scale"][self.inputs]
        return pulled if self.forced else pulled + values["pre_stretch"]

    def stiffness(self, values: Values) -> Tensor:
        """Diagonal of K (3 n_b,): N m/rad and N/m, of sections in series with a material's EI and EA."""
        bending = values["bending_rigidity"] / values["rest_length"]
        axial = values["axial_rigidity"] / values["rest_length"]
        return torch.stack((bending, bending, axial), dim=-1).flatten()

    def balance(self, q: Tensor, pulled: Tensor, slide: Tensor, values: Values) -> Tensor:
        """Unbalanced generalized force (N, 3 n_b): zero at rest."""
        B = self.matrix(values)
        stiffness = values["tendon_stiffness"]
        if self.forced:
            tension = elastic_tension(pulled, torch.ones_like(stiffness))  # a motor does not push either
        else:
            tension = elastic_tension(pulled + q @ B, stiffness)
        rest = torch.nn.functional.pad(values["rest_bend"].unflatten(-1, (-1, 2)), (0, 1)).flatten(-2)
        elastic = self.stiffness(values) * (q - rest)
        share = tension_share(self.fractions, q, values["friction"] * slide)
        blocks = B.unflatten(0, (-1, 3)) * share.unsqueeze(-2)
        return elastic + (blocks * tension[:, None, None, :]).sum(-1).flatten(-2) - self.weight(q, values)

    def weight(self, q: Tensor, values: Values) -> Tensor:
        """Generalized force of the weight (N, 3 n_b): the mass of a section is spread over its length."""
        down = so3.exp(values["base_rotation"]).mT @ values["gravity"]
        share, masses = self._shares(values)
        chain = self.backbone.chain(q, values["rest_length"])
        local = (chain.before.mT @ down).unsqueeze(-2)  # (N, n_b, 1, 3), gravity in the axes of each section's base
        x = self._nodes.unsqueeze(-1)
        arcs = arc_geometry(chain.x.unsqueeze(-1) * self._nodes, chain.y.unsqueeze(-1) * self._nodes)
        length = chain.length[..., None, None]
        # What a section's own bend and length do to its own mass, ...
        bend = length * (x * x) * (local.unsqueeze(-2) @ arcs.bend).squeeze(-2)
        stretch = x * (local * arcs.chord).sum(-1, keepdim=True)
        own = (share.unsqueeze(-1) * torch.cat((bend, stretch), dim=-1)).sum(-2)
        # ... and to the mass beyond it, which they turn and carry as one body.
        starts = torch.nn.functional.pad(chain.ends[..., :-1, :], (0, 0, 1, 0))
        points = starts.unsqueeze(-2) + length * x * (arcs.chord @ chain.before.mT)
        moments = (share.unsqueeze(-1) * points).sum(-2)
        beyond = moments.flip(-2).cumsum(-2).flip(-2) - moments
        mass = (masses.flip(0).cumsum(0).flip(0) - masses).unsqueeze(-1)
        lever = torch.linalg.cross(beyond - mass * chain.ends, down.expand_as(beyond), dim=-1)
        turned = ((chain.before @ chain.arcs.spin).mT @ lever.unsqueeze(-1)).squeeze(-1)
        carried = mass * (
            local @ torch.cat((chain.length[..., None, None] * chain.arcs.bend, chain.arcs.columns[..., 4:]), -1)
        ).squeeze(-2)
        return (own + carried + torch.nn.functional.pad(turned, (0, 1))).flatten(-2)

    def _shares(self, values: Values) -> tuple[Tensor, Tensor]:
        """Mass at the sections' nodes (n_b, nodes) and of the sections (n_b,), kg, with the payload at the last tip."""
        share, masses, payload = self._weights * self.masses.unsqueeze(-1), self.masses, values.get(TIP_MASS)
        if payload is not None:
            share = share + torch.nn.functional.pad(payload.unsqueeze(0), (share.shape[-1] - 1, 0, len(share) - 1, 0))
            masses = masses + torch.nn.functional.pad(payload, (len(masses) - 1, 0))
        return share, masses

    def slide(self, drive: Drive) -> Tensor:
        """Direction in which each tendon last moved (N, n_a): +1 pulled in, -1 paid out."""
        return drive.slide[:, self.inputs] * torch.sign(self.pulls)

    def slope(self, q: Tensor, pulled: Tensor, slide: Tensor, values: Values, force: Tensor | None = None) -> Tensor:
        """Derivative (N, n, n) of `balance` by q, from differences; carries no gradient.

        From central ones its error, some 1e-9 of the stiffness, is far below what an interval can tell. With the
        balance `force` (N, n) at q they are taken ahead alone, in half of the time, as well as Newton's method needs.
        """
        with torch.no_grad():
            n = q.shape[-1]
            steps = _STEP * torch.eye(n, dtype=q.dtype, device=q.device)
            ways = (1.0, -1.0) if force is None else (1.0,)
            moved = torch.stack([q.unsqueeze(-2) + way * steps for way in ways]).flatten(0, -2)
            many = (len(ways), len(q), n)
            pulled, slide = (v.unsqueeze(-2).expand(*many, -1).flatten(0, -2) for v in (pulled, slide))
            there = self.balance(moved, pulled, slide, values).unflatten(0, many)
            if force is None:
                return ((there[0] - there[1]) / (2.0 * _STEP)).mT
            return ((there[0] - force.unsqueeze(-2)) / _STEP).mT

    def bends(self, pulled: Tensor, values: Values) -> Tensor:
        """q (N, 3 n_b) of the kinematic model: the bends that best agree with all tendons' lengths, no elongation.

        Raises:
            ConfigError: The inputs set tensions.
        """
        if self.forced:
            raise ConfigError("it knows no forces, and the inputs set tensions: actuation.sets is tension")
        bending = self.matrix(values).unflatten(0, (-1, 3))[:, :2].flatten(0, 1)
        q = -pulled @ torch.linalg.pinv(bending)
        return torch.nn.functional.pad(q.unflatten(-1, (-1, 2)), (0, 1)).flatten(-2)

    def rest(self, drive: Drive, values: Values, q: Tensor | None = None, iterations: int = 60) -> Tensor:
        """Equilibrium q (N, 3 n_b), without gradient; a row that does not converge is NaN.

        Args:
            drive: What drives the arm.
            values: Of the blocks.
            q: First guess; None is the straight arm.
            iterations: Most steps of Newton's method.
        """
        with torch.no_grad():
            pulled, slide = self.pulled(drive, values), self.slide(drive)
            if self.kinematic:
                return self.bends(pulled, values)
            K = self.stiffness(values)
            if q is None:
                q = torch.zeros(len(pulled), len(K), dtype=pulled.dtype)
            q = torch.where(q.isfinite(), q, 0.0)
            force = self.balance(q, pulled, slide, values)
            merit, scale = _energy(force, K), torch.ones(len(q), dtype=q.dtype)
            slope, stale = q.new_zeros(*q.shape, q.shape[-1]), torch.ones(len(q), dtype=torch.bool)
            left = torch.arange(len(q))
            for _ in range(iterations):
                left = left[~(merit[left] <= _SETTLED * _energy(K * q[left], K).clamp(min=_LEAST))]
                if not len(left):
                    break
                fresh = stale[left]
                renewed = left[fresh]
                if len(renewed):
                    at = q[renewed], pulled[renewed], slide[renewed]
                    slope[renewed] = self.slope(*at, values, force[renewed])
                step = torch.linalg.solve_ex(slope[left], -force[left].unsqueeze(-1))[0].squeeze(-1)
                # No section turns by more than a radian in one step.
                largest = step.unflatten(-1, (-1, 3))[..., :2].abs().amax((-2, -1))
                trial = q[left] + step * (scale[left] / largest.clamp(min=1.0)).unsqueeze(-1)
                there = self.balance(trial, pulled[left], slide[left], values)
                energy = _energy(there, K)
                lower = energy < merit[left]
                stale[left] = ~(energy < _FALLS * merit[left])
                # Where the slope was an old one, that may be why it fell no further.
                shorter = torch.where(fresh, 0.4 * scale[left], scale[left])
                scale[left] = torch.where(lower, (2.0 * scale[left]).clamp(max=1.0), shorter)
                kept = left[lower]
                q[kept], force[kept], merit[kept] = trial[lower], there[lower], energy[lower]
            return q.index_fill(0, left, torch.nan)

    def resting_slope(self, drive: Drive, values: Values, q: Tensor) -> Tensor | None:
        """`slope` (N, n, n) at the equilibrium q; None for the kinematic model, which has no balance."""
        return None if self.kinematic else self.slope(q, self.pulled(drive, values), self.slide(drive), values)

    def positions(self, drive: Drive, values: Values, q: Tensor, slope: Tensor | None) -> Tensor:
        """Where the bodies are (N, k, 3), m, recording frame, given the equilibrium; differentiable in the values.

        Args:
            drive: What drives the arm.
            values: Of the blocks.
            q: (N, 3 n_b) the equilibrium at these values, from `rest`.
            slope: (N, 3 n_b, 3 n_b) from `resting_slope`.
        """
        pulled = self.pulled(drive, values)
        if slope is None:
            q = self.bends(pulled, values)
        else:
            # At the equilibrium this step is zero; its derivative is that of the implicit function.
            unbalanced = self.balance(q, pulled, self.slide(drive), values)
            q = q - torch.linalg.solve_ex(slope, unbalanced.unsqueeze(-1))[0].squeeze(-1)
        return self.bodies(q, values)

    def bodies(self, q: Tensor, values: Values) -> Tensor:
        """Positions (N, k, 3) of the bodies of an arm in the configuration q (N, 3 n_b), m, recording frame."""
        lengths = values["rest_length"]
        mounts = values["mount"].unflatten(-1, (-1, 3)).unsqueeze(-1)
        if self.at_tips:
            chain = self.backbone.chain(q, lengths)
            turns = torch.cat((chain.before[:, 1:], chain.rotation.unsqueeze(-3)), dim=-3)
            places, turns = chain.ends[:, self.section], turns[:, self.section]
        else:
            poses = self.backbone.pose(q, lengths, self.X_tilde, self.section)
            places, turns = poses[..., :3, 3], poses[..., :3, :3]
        local = places + (turns @ mounts).squeeze(-1)
        return local @ so3.exp(values["base_rotation"]).mT + values["base_position"]

    def predict(self, drive: Drive, values: Values) -> Tensor:
        """Where the bodies are (N, k, 3), m, recording frame; NaN where there is no equilibrium."""
        return self.bodies(self.rest(drive, values), values)


def _energy(force: Tensor, K: Tensor) -> Tensor:
    """Elastic energy (N,) that generalized forces (N, n) would store, J, twice."""
    return (force * force / K).sum(-1)
