"""What the dynamics of arms have in common, whatever their sections: lengths, masses, stiffness, damping, a base."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from apcc_torch.errors import ValueRangeError
from apcc_torch.linalg import solve_spd
from apcc_torch.model.abscissae import located
from apcc_torch.model.equation_of_motion import Energy, EquationOfMotion
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.loads import Loads, Payload
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_rows
from apcc_torch.shapes import batch_shape, check_finite, check_positive, check_same, check_tensor


class ArmDynamics(Part, ABC):
    """M(q) qddot + C(q, qdot) qdot + G(q) + D qdot + K q = tau + tau_ext, with a constant diagonal K and D.

    Args:
        lengths: (..., n_b) section rest lengths, m.
        masses: (..., n_b) section masses, kg.
        damping_ratio: D = damping_ratio K, s. Used when `damping` is None.
        damping: (..., n) diagonal of D, N m s/rad of angles, N s/m of lengths.
        base_rotation: (..., 3, 3) arm base to world; None is the identity. A hanging arm has diag(1, -1, -1).
        gravity: Acceleration of gravity along world -z, m/s^2.
        **stiffness: (..., n_b) of each of `springs`, N m/rad or N/m.

    Raises:
        ShapeError: The parameters' shapes do not agree.
        ValueRangeError: A length, mass or stiffness is not positive, or a damping is negative.
    """

    springs: ClassVar[tuple[str, ...]]
    """Of each coordinate of a section the stiffness that holds it."""

    lengths: Tensor
    masses: Tensor
    damping_ratio: Tensor
    own_damping: Tensor | None
    base_rotation: Tensor
    gravity_acceleration: Tensor
    batch_marker: Tensor

    def __init__(
        self,
        lengths: Tensor,
        masses: Tensor,
        damping_ratio: float | Tensor,
        damping: Tensor | None,
        base_rotation: Tensor | None,
        gravity: float | Tensor,
        **stiffness: Tensor,
    ) -> None:
        super().__init__()
        check_positive("lengths", check_tensor("lengths", lengths, (None,)))
        n_b, dtype, device = lengths.shape[-1], lengths.dtype, lengths.device
        given = {"masses": masses, **stiffness}
        for name, value in given.items():
            check_positive(name, check_tensor(name, value, (n_b,)))
        check_same(lengths=lengths, **given)
        base_rotation = torch.eye(3, dtype=dtype, device=device) if base_rotation is None else base_rotation
        check_finite("base_rotation", check_tensor("base_rotation", base_rotation, (3, 3)))
        ratio, acceleration = (
            value if isinstance(value, nn.Parameter) else torch.as_tensor(value, dtype=dtype, device=device)
            for value in (damping_ratio, gravity)
        )
        self.n_sections = n_b
        rows: dict[str, Any] = {name: (value, 1) for name, value in {"lengths": lengths, **given}.items()}
        hold_rows(self, **rows, base_rotation=(base_rotation, 2))
        hold_rows(self, damping_ratio=(ratio, 0), own_damping=(damping, 1), gravity_acceleration=(acceleration, 0))
        viscous = check_finite("damping", check_tensor("damping", self.damping_diagonal, (self.n,)))
        if not holds(viscous >= 0):
            raise ValueRangeError("damping must not be negative")
        check_same(lengths=lengths, damping=viscous, base_rotation=base_rotation)
        batch = batch_shape(
            lengths=(lengths, 1), masses=(masses, 1), stiffness=(self.stiffness_diagonal, 1), damping=(viscous, 1),
            base_rotation=(base_rotation, 2), gravity=(acceleration, 0),
        )  # fmt: skip
        hold_rows(self, batch_marker=(torch.zeros(batch, dtype=dtype, device=device), 0))

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.n_sections * len(self.springs)

    @abstractmethod
    def kinematics(self) -> KinematicModel:
        """The model that places its points; of an arm with one base for all rows."""

    def spring(self, name: str) -> Tensor:
        """(..., n_b) the stiffness of one name, of its section as it is modelled."""
        value: Tensor = getattr(self, name)
        return value

    @property
    def diagonals(self) -> tuple[Tensor, Tensor]:
        """Diagonals (..., n) of K, N m/rad of angles and N/m of lengths, and of D, the same times s."""
        springs = {name: self.spring(name) for name in self.springs}
        stiffness = [springs[name] for name in self.springs]
        if len({value.shape for value in stiffness}) > 1:
            stiffness = list(torch.broadcast_tensors(*stiffness))
        K, own = torch.stack(stiffness, dim=-1).flatten(-2), self.own_damping
        return K, self.damping_ratio.unsqueeze(-1) * K if own is None else own

    @property
    def stiffness_diagonal(self) -> Tensor:
        """The first of `diagonals`."""
        return self.diagonals[0]

    @property
    def damping_diagonal(self) -> Tensor:
        """The second of `diagonals`."""
        return self.diagonals[1]

    @property
    def stiffness(self) -> Tensor:
        """K (..., n, n), diagonal: K q = dU_elastic/dq, Eq. (38) [Dalenberg]."""
        return torch.diag_embed(self.stiffness_diagonal)

    @property
    def damping(self) -> Tensor:
        """D (..., n, n), diagonal."""
        return torch.diag_embed(self.damping_diagonal)

    def gravity(self, q: Tensor, payload: Payload = None) -> Tensor:
        """G(q) = dU_gravity/dq (..., n), Eq. (38) [Dalenberg]; arguments as for `forward`."""
        return self.static_load(q, payload)

    def static_load(
        self,
        q: Tensor,
        payload: Payload = None,
        wrench: Tensor | None = None,
        distributed: Tensor | None = None,
        section_wrenches: Tensor | None = None,
        places: Tensor | None = None,
        place_wrenches: Tensor | None = None,
    ) -> Tensor:
        """G(q) less the external loads (..., n), what tau - K q balances at rest; arguments as for `forward`."""
        loads = Loads(wrench, distributed, section_wrenches, places, place_wrenches)
        return self.less_placed(self._at_rest(q, payload, loads), q, loads)

    def equation(
        self,
        q: Tensor,
        qdot: Tensor,
        payload: Payload = None,
        wrench: Tensor | None = None,
        distributed: Tensor | None = None,
        section_wrenches: Tensor | None = None,
        places: Tensor | None = None,
        place_wrenches: Tensor | None = None,
    ) -> EquationOfMotion:
        """M and C qdot + G less external loads, in one pass; arguments as for `forward`."""
        loads = Loads(wrench, distributed, section_wrenches, places, place_wrenches)
        inertia, bias = self._in_motion(q, qdot, payload, loads)
        return EquationOfMotion(self._assembled(inertia), self.less_placed(bias, q, loads))

    def forward(
        self,
        q: Tensor,
        qdot: Tensor,
        tau: Tensor,
        payload: Payload = None,
        wrench: Tensor | None = None,
        distributed: Tensor | None = None,
        section_wrenches: Tensor | None = None,
        places: Tensor | None = None,
        place_wrenches: Tensor | None = None,
    ) -> Tensor:
        """Accelerations qddot (..., n) from Eq. (35) [Dalenberg]; a row that cannot be solved is NaN.

        Args:
            q: (..., n) rad of angles, m of lengths.
            qdot: (..., n) their rates.
            tau: (..., n) generalized actuation B u, N m of angles, N of lengths.
            payload: (...) point mass at the tip, kg.
            wrench: (..., 6) external torque (N m) and force (N) at the tip, world axes.
            distributed: (..., 3) external load per material length, world axes, N/m.
            section_wrenches: (..., n_b, 6) external torque and force at every section's tip, world axes.
            places: (..., p) material abscissae, m.
            place_wrenches: (..., p, 6) external torque and force there, world axes.
        """
        check_tensor("tau", tau, (self.n,))
        loads = Loads(wrench, distributed, section_wrenches, places, place_wrenches)
        inertia, bias = self._in_motion(q, qdot, payload, loads)
        K, D = self.diagonals
        return self._solved(inertia, tau - self.less_placed(bias, q, loads) - K * q - D * qdot)  # Eq. (35)

    @abstractmethod
    def _at_rest(self, q: Tensor, payload: Payload, loads: Loads) -> Tensor:
        """`static_load` without what `less_placed` takes off."""

    @abstractmethod
    def _in_motion(self, q: Tensor, qdot: Tensor, payload: Payload, loads: Loads) -> tuple[Any, Tensor]:
        """M in the form that `_assembled` and `_solved` take, and the bias without what `less_placed` takes off."""

    def _assembled(self, inertia: Any) -> Tensor:
        """M (..., n, n)."""
        M: Tensor = inertia
        return M

    def _solved(self, inertia: Any, force: Tensor) -> Tensor:
        """M^-1 force (..., n)."""
        return solve_spd(inertia, force.unsqueeze(-1)).squeeze(-1)

    @abstractmethod
    def energy(self, q: Tensor, qdot: Tensor, payload: Payload = None) -> Energy:
        """Kinetic and potential energy, J; see `Energy`. Heights are measured from the world origin."""

    def less_placed(self, force: Tensor, q: Tensor, loads: Loads) -> Tensor:
        """A generalized force (..., n) less J(X)^T w of the wrenches w at any places X of the arm at q (..., n)."""
        if loads.places is None or loads.place_wrenches is None:
            return force
        X, w, L0 = loads.places, loads.place_wrenches, self.lengths
        batch = batch_shape(q=(q, 1), places=(X, 1), place_wrenches=(w, 2), lengths=(L0, 1))
        q, X, L0 = (value.expand(*batch, value.shape[-1]) for value in (q, X, L0))
        model = self.kinematics()
        chain = model.chain_to(q, model.material_points(L0, *located(X, L0)))
        own = torch.cat([chain.rotation.mT @ part.unsqueeze(-1) for part in w.split(3, dim=-1)], dim=-2)
        return force - (chain.body_jacobian().mT @ own).squeeze(-1).sum(-2)

    def checked(self, payload: Payload, loads: Loads | None = None, **coordinates: Tensor) -> torch.Size:
        """The leading shape of the arm, its coordinates (..., n) and what it bears; raises where they do not fit."""
        given = {name: (check_tensor(name, value, (self.n,)), 1) for name, value in coordinates.items()}
        if loads is not None:
            given |= loads.checked(self.n_sections)
        same = {name: value for name, (value, _) in given.items()}
        check_same(lengths=self.lengths, **same, **({"payload": payload} if isinstance(payload, Tensor) else {}))
        return self.batch_of(payload, **given)

    def batch_of(self, payload: Payload, **tensors: tuple[Tensor, int]) -> torch.Size:
        """The leading shape of the arm's parameters with a payload and tensors; raises where they do not broadcast."""
        if isinstance(payload, bool) or not isinstance(payload, int | float | None):
            tensors = tensors | {"payload": (check_tensor("payload", payload, ()), 0)}
        return batch_shape(parameters=(self.batch_marker, 0), **tensors)
