"""Load from the shape that tendons of known length leave: no tension sensor is needed, and one sharpens the estimate.

Tendons that are held at their lengths fix as many numbers of the shape as there are tendons; how the arm lies between
is the load's doing. The arm's equilibrium under prescribed lengths predicts where every sensor is, and what every
tendon pulls; Gauss-Newton over the load brings the predictions to what is seen. The model must have more coordinates
than the arm has tendons, so it is finer than the controller's: with as many, the lengths alone tell the whole shape.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.weighted_estimate import EstimateStatus, WeightedEstimate, weighted_estimate
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import located
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.loads import Loads
from apcc_torch.model.statics import Equilibrium, equilibrium, load_stiffness
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import batch_shape, check_finite, check_tensor

UNKNOWNS = ("payload", "force")


class ShapeNoise(NamedTuple):
    """Standard deviations of what is seen against what the model predicts, sensors' and model's error together.

    position: Of each coordinate of a sensor, m. angle: Of each component of its rotation vector, rad.
    length: Of each tendon's length change, m. tension: Of each tendon's force, N.

    Example:
        >>> ShapeNoise(position=2e-3).tension
        0.5
    """

    position: Setting = 1e-3
    angle: Setting = 0.02
    length: Setting = 1e-4
    tension: Setting = 0.5


class LoadEstimate(NamedTuple):
    """A load and the shape it explains.

    load: Payload (..., 1) kg or tip force (..., 3) N in world axes, with covariance and status.
    q: (..., n) configuration of the finer model under it.
    u: (..., n_a) forces of the tendons it predicts, N; tension is -u.
    converged: (...) bool, the shape is at rest and the last step was negligible. A row that finds no rest is INVALID.
    """

    load: WeightedEstimate
    q: Tensor
    u: Tensor
    converged: Tensor


class LoadFromShape(Part):
    """Estimates a payload or a tip force from tendon lengths and sensor poses, tendon forces, or both.

    Args:
        dynamics: The finer model; of it, the static terms.
        routing: The arm's tendons.
        abscissae: (k,) material abscissae of the sensors, m.
        unknown: "payload", the mass at the tip, or "force", the force there.
        noise: How far predictions may be off.
        iterations: Gauss-Newton steps.
        step: Largest step of the force, N.
        limit: Largest standard deviation of a force component that counts as determined, N.

    Raises:
        ConfigError: The unknown is not known.
        ValueRangeError: A number is out of range.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> finer, y = arm.dynamics(2), torch.zeros(6).double()
        >>> held = equilibrium(finer, routing=arm.routing(), tendon_lengths=y, payload=torch.tensor(0.1).double())
        >>> LoadFromShape(finer, arm.routing(), arm.sensor_places())(y, u=held.u).load.value
        tensor([0.1000], dtype=torch.float64)
    """

    abscissae: Tensor
    position_noise: Setting
    angle_noise: Setting
    length_noise: Setting
    tension_noise: Setting

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        abscissae: Tensor,
        unknown: str = "payload",
        noise: ShapeNoise | None = None,
        iterations: int = 8,
        step: float = 3.0,
        limit: float = 5.0,
    ) -> None:
        super().__init__()
        if unknown not in UNKNOWNS:
            raise ConfigError(f"unknown must be one of {', '.join(UNKNOWNS)}, got {unknown!r}")
        if iterations < 1:
            raise ValueRangeError(f"iterations must be at least 1, got {iterations}")
        check_finite("abscissae", check_tensor("abscissae", abscissae, (None,)))
        noise = ShapeNoise() if noise is None else noise
        for name, value in noise._asdict().items():
            check_setting(f"noise.{name}", value)
        self.dynamics = dynamics
        self.routing = routing
        self.backbone = PCCBackbone(dynamics.n_sections, dynamics.base_rotation)
        self.unknown = unknown
        self.iterations = iterations
        self.step = check_setting("step", step)
        self.limit = check_setting("limit", limit)
        hold_rows(self, abscissae=(abscissae, 1))
        hold_numbers(self, **{f"{name}_noise": value for name, value in noise._asdict().items()})

    def forward(
        self, y: Tensor, T: Tensor | None = None, u: Tensor | None = None, mask: Tensor | None = None
    ) -> LoadEstimate:
        """The load of each row.

        Args:
            y: (..., n_a) tendon length changes, m.
            T: (..., k, 4, 4) sensor poses, world frame; None: nobody looks.
            u: (..., n_a) tendon forces, N; None: nobody measures them.
            mask: (..., k) bool, False for a sensor to leave out; a sensor that is not finite is left out too.

        Raises:
            ConfigError: Neither poses nor forces are given.
        """
        n_a, k = self.routing.n_tendons, self.abscissae.shape[-1]
        check_tensor("y", y, (n_a,))
        if T is None and u is None:
            raise ConfigError("give sensor poses T, tendon forces u, or both")
        shapes = {"y": (y, 1)}
        if T is not None:
            shapes["T"] = (check_tensor("T", T, (k, 4, 4)), 3)
        if u is not None:
            shapes["u"] = (check_tensor("u", u, (n_a,)), 1)
        batch = batch_shape(parameters=(self.dynamics.batch_marker, 0), **shapes)
        y = y.expand(*batch, n_a)
        p = 1 if self.unknown == "payload" else 3
        load = torch.zeros(*batch, p, dtype=y.dtype, device=y.device)
        q: Tensor | None = None
        largest = self.step / self._per_newton()
        small = torch.zeros(batch, dtype=torch.bool, device=y.device)
        for _ in range(self.iterations):
            rest = self._rest(y, load, q)
            result = self._step(rest, load, T, u, mask)
            change = torch.where(torch.isfinite(result.value), result.value, 0.0)
            # One length for the whole step, so that its direction stays.
            change = change / (change.norm(dim=-1, keepdim=True) / largest).clamp(min=1.0)
            small = change.norm(dim=-1) < 1e-3 * largest
            q, load = rest.q, load + change
        rest = self._rest(y, load, q)
        assert rest.u is not None  # tendon lengths are prescribed
        known = torch.isfinite(result.value) & rest.converged.unsqueeze(-1)
        status = torch.where(rest.converged, result.status, int(EstimateStatus.INVALID))
        final = result._replace(value=torch.where(known, load, torch.nan), status=status)
        return LoadEstimate(final, rest.q, rest.u, rest.converged & small)

    def _per_newton(self) -> float | Tensor:
        """What a unit of the unknown weighs, N."""
        return self.dynamics.gravity_acceleration.max() if self.unknown == "payload" else 1.0

    def _loads(self, load: Tensor) -> tuple[Tensor | None, Loads]:
        if self.unknown == "payload":
            return load.squeeze(-1), Loads()
        return None, Loads(torch.nn.functional.pad(load, (3, 0)))

    def _rest(self, y: Tensor, load: Tensor, q: Tensor | None) -> Equilibrium:
        payload, loads = self._loads(load)
        with torch.no_grad():
            return equilibrium(
                self.dynamics, routing=self.routing, tendon_lengths=y, payload=payload, loads=loads, q=q, tolerance=1e-8
            )

    def _step(
        self, rest: Equilibrium, load: Tensor, T: Tensor | None, u: Tensor | None, mask: Tensor | None
    ) -> WeightedEstimate:
        """The linear problem of one Gauss-Newton step, around a shape at rest."""
        assert rest.u is not None  # tendon lengths are prescribed
        q_by_load, u_by_load, q_by_y, u_by_y = self._sensitivity(rest.q, load)
        residuals, by_load, by_y, variances = [], [], [], []
        if T is not None:
            twist, body = self._seen(rest.q, T, mask)
            residuals.append(twist)
            by_load.append(body @ q_by_load)
            by_y.append(body @ q_by_y)
            noises = (self.angle_noise, self.position_noise)
            sensor = torch.cat([aligned(s, 1) * torch.ones_like(twist[..., :3]) for s in noises], dim=-1)
            variances.append(sensor.repeat(*[1] * (twist.dim() - 1), self.abscissae.shape[-1]) ** 2)
        if u is not None:
            residuals.append(u - rest.u)
            by_load.append(u_by_load)
            by_y.append(u_by_y)
            variances.append(aligned(self.tension_noise, 1) ** 2 * torch.ones_like(rest.u))
        slide = aligned(self.length_noise, 2) * torch.cat(by_y, dim=-2)
        S = torch.diag_embed(torch.cat(variances, dim=-1)) + slide @ slide.mT
        limit = torch.full_like(load[(0,) * (load.dim() - 1)], self.limit) / self._per_newton()
        return weighted_estimate(torch.cat(residuals, dim=-1), torch.cat(by_load, dim=-2), S, limit)

    def _sensitivity(self, q: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """How q and u at rest follow the load and the tendon lengths, by the implicit function theorem."""
        payload, loads = self._loads(load)
        _, slope = load_stiffness(self.dynamics, q, payload, loads)
        A = self.dynamics.stiffness + slope
        B = self.routing.matrix(self.dynamics.lengths).expand(*A.shape[:-1], self.routing.n_tendons)
        n, n_a = B.shape[-2:]
        zero = torch.zeros(*A.shape[:-2], n_a, n_a, dtype=A.dtype, device=A.device)
        system = torch.cat((torch.cat((A, -B), dim=-1), torch.cat((B.mT, zero), dim=-1)), dim=-2)
        # The load enters the balance linearly, so one difference is its derivative.
        still = self.dynamics.static_load(q)
        p = load.shape[-1]
        units = torch.eye(p, dtype=q.dtype, device=q.device).view(p, *[1] * (q.dim() - 1), p)
        unit_payload, unit_loads = self._loads(units.expand(p, *q.shape[:-1], p))
        pushed = still - self.dynamics.static_load(q.expand(p, *q.shape), unit_payload, *unit_loads)
        right = torch.nn.functional.pad(pushed.movedim(0, -1), (0, 0, 0, n_a))
        held = torch.zeros(n, n_a, dtype=q.dtype, device=q.device)
        held = torch.cat((held, torch.eye(n_a, dtype=q.dtype, device=q.device)), dim=-2)
        solved = torch.linalg.solve_ex(system, torch.cat((right, held.expand(*right.shape[:-1], n_a)), dim=-1))[0]
        return solved[..., :n, :p], solved[..., n:, :p], solved[..., :n, p:], solved[..., n:, p:]

    def _seen(self, q: Tensor, T: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Twists (..., 6 k) from the model to the sensors and body Jacobians (..., 6 k, n), zero of one left out."""
        batch, k = q.shape[:-1], self.abscissae.shape[-1]
        L0 = self.dynamics.lengths.expand(*batch, self.dynamics.n_sections)
        X_tilde, j = located(self.abscissae.to(q).expand(*batch, k), L0)
        predicted, body = self.backbone.pose_and_body_jacobian(q, L0, X_tilde, j)
        usable = torch.isfinite(T).flatten(-2).all(-1)
        if mask is not None:
            usable = usable & mask
        seen = torch.where(usable[..., None, None], T, predicted)
        twist = se3.log(se3.inverse(predicted) @ seen)
        body = torch.where(usable[..., None, None], body, 0.0)
        return twist.flatten(-2), body.flatten(-3, -2)
