"""Algorithm 2: the model's configuration from the poses of any number of sensors, batched, row by row converged."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.step import Residual, hierarchical_step, least_squares_step
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.shapes import batch_shape, check_finite, check_same, check_tensor

MODES = ("position", "pose", "hierarchical")


class FeedbackStatus(IntEnum):
    """How a row of the estimate ended."""

    CONVERGED = 0
    """Every sensor is within both thresholds."""
    SETTLED = 1
    """The step became negligible with a residual above the thresholds: the model cannot fit the sensors better."""
    ITERATION_LIMIT = 2
    """The iterations ran out first."""
    INVALID = 3
    """No usable sensor, or a non-finite seed or parameter: q_bar is the seed."""


class Feedback(NamedTuple):
    """Result of algorithm 2.

    q_bar: (..., 3 n_b) inferred configuration.
    angular_error: (..., k) norm of the angular part of Eq. (30), rad; 0 for a sensor that is masked.
    linear_error: (..., k) norm of the linear part of Eq. (30), or of Eq. (32) outside mode "pose", m; 0 for a sensor
        that is masked.
    iterations: (...) int64 steps computed.
    status: (...) int64 `FeedbackStatus`.
    """

    q_bar: Tensor
    angular_error: Tensor
    linear_error: Tensor
    iterations: Tensor
    status: Tensor


class _Fit(NamedTuple):
    """One evaluation of the model against the sensors."""

    q: Tensor
    residual: Residual
    cost: Tensor  # (...) m^2
    position_cost: Tensor  # (...) m^2


class StateFeedback(nn.Module):
    """Decoupled state feedback. Algorithm 2, Eqs. (27)-(32), remark 4 [Dalenberg].

    Each iteration is a Levenberg-Marquardt step with a bound on its length: plain Gauss-Newton, Eq. (31), diverges on
    strongly bent shapes, and the stacked Jacobian is not square. A step that does not lower the cost is refused and
    the damping raised; rows that are done freeze while others go on. The loop runs while either error is above its
    threshold (the printed algorithm joins them with "&", which stops at the first).

    Modes: "position" fits the sensors' positions only, Eq. (32); "pose" fits Eq. (30) with `angular_weight` metres to
    the radian (the paper's is 1); "hierarchical" fits positions first and orientations in the null space that the
    positions leave.

    Args:
        backbone: The model.
        abscissae: (k,) material abscissae of the sensors, m, increasing, S_s of Eq. (22).
        mode: "position", "pose" or "hierarchical".
        angular_weight: Metres that one radian of angular error counts as.
        max_iterations: Largest number of steps, the paper's N = 7.
        min_iterations: Steps taken even where the seed is within the thresholds, so that a slow motion is followed
            and not quantised by the thresholds.
        linear_threshold: m.
        angular_threshold: rad.
        bend_step: Largest change of a bend in one step, rad.
        length_step: Largest change of a section's elongation in one step, m.
        damping: First Levenberg-Marquardt damping, m^2.
        settled_step: A step with every entry (rad, m) below this ends the row.

    Raises:
        ValueRangeError: The sensor set is empty, not sorted or negative, or a setting is out of range.
    """

    abscissae: Tensor

    def __init__(
        self,
        backbone: PCCBackbone,
        abscissae: Tensor,
        mode: str = "pose",
        angular_weight: float = 1.0,
        max_iterations: int = 7,
        min_iterations: int = 1,
        linear_threshold: float = 1e-4,
        angular_threshold: float = 5e-3,
        bend_step: float = 0.6,
        length_step: float = 0.1,
        damping: float = 1e-8,
        settled_step: float = 1e-7,
    ) -> None:
        super().__init__()
        check_tensor("abscissae", abscissae, (None,))
        check_finite("abscissae", abscissae)
        if abscissae.shape[-1] == 0:
            raise ValueRangeError("abscissae must name at least one sensor, got an empty set")
        if bool((abscissae.diff(dim=-1) <= 0).any()) or bool((abscissae < 0).any()):
            raise ValueRangeError(f"abscissae must be increasing and not negative, got {abscissae.tolist()}")
        if mode not in MODES:
            raise ValueRangeError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
        positive = {
            "angular_weight": angular_weight,
            "max_iterations": max_iterations,
            "linear_threshold": linear_threshold,
            "angular_threshold": angular_threshold,
            "bend_step": bend_step,
            "length_step": length_step,
            "damping": damping,
        }
        for name, value in positive.items():
            if not 0 < value < float("inf"):
                raise ValueRangeError(f"{name} must be positive and finite, got {value}")
        if not 0 <= min_iterations <= max_iterations:
            raise ValueRangeError(f"min_iterations must be between 0 and max_iterations, got {min_iterations}")
        self.backbone = backbone
        self.mode = mode
        self.angular_weight = angular_weight
        self.max_iterations = max_iterations
        self.min_iterations = min_iterations
        self.linear_threshold = linear_threshold
        self.angular_threshold = angular_threshold
        self.bend_step = bend_step
        self.length_step = length_step
        self.damping = damping
        self.settled_step = settled_step
        self.register_buffer("abscissae", abscissae.detach().clone())

    def forward(
        self,
        q_seed: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> Feedback:
        """Infers q_bar from sensor poses with the parameters frozen.

        Args:
            q_seed: (..., 3 n_b) first guess, the previous q_bar (remark 4).
            pi_hat: (..., n_b) parameter estimates, m.
            T: (..., k, 4, 4) measured sensor poses, world frame. Non-finite sensors count as masked.
            mask: (..., k) bool, False for a sensor to leave out; None for all.
            angular_mask: (..., k) bool, False for a sensor whose orientation to leave out; None for `mask`.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        k = self.abscissae.shape[-1]
        self.backbone.check(q_seed, pi_hat)
        check_tensor("T", T, (k, 4, 4))
        check_same(q_seed=q_seed, T=T)
        usable, oriented = self.used(T, mask, angular_mask)
        batch = batch_shape(q_seed=(q_seed, 1), pi_hat=(pi_hat, 1), sensors=(oriented, 1))
        usable, oriented = usable.expand(*batch, k), oriented.expand(*batch, k)
        X_tilde, j = decouple(self._abscissae(pi_hat), pi_hat)

        def evaluate(q: Tensor) -> _Fit:
            model, body = self.backbone.pose_and_body_jacobian(q, pi_hat, X_tilde, j)
            return self._fit(q, model, body, T, usable, oriented)

        return self._iterate(q_seed.expand(*batch, q_seed.shape[-1]), evaluate, usable)

    def used(self, T: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Which sensors, and which orientations, count: two bool (..., k). Arguments as `forward`."""
        k = self.abscissae.shape[-1]
        leading = {"T": (T, 3)}
        for name, given in {"mask": mask, "angular_mask": angular_mask}.items():
            if given is not None:
                leading[name] = (_check_mask(name, given, k), 1)
        batch_shape(**leading)
        usable = torch.isfinite(T).all(-1).all(-1)
        usable = usable if mask is None else usable & mask
        return usable, usable if angular_mask is None else usable & angular_mask

    def _abscissae(self, like: Tensor) -> Tensor:
        return self.abscissae.to(dtype=like.dtype, device=like.device)

    def _fit(self, q: Tensor, model: Tensor, body: Tensor, T: Tensor, usable: Tensor, oriented: Tensor) -> _Fit:
        # What is left out is measured where the model has it: it pulls nowhere, and nothing non-finite enters.
        offset = torch.where(usable.unsqueeze(-1), T[..., :3, 3] - model[..., :3, 3], 0.0)
        into_body = model[..., :3, :3].mT
        linear = (into_body @ offset.unsqueeze(-1)).squeeze(-1)  # Eq. (32), in the sensor's own axes
        angular = torch.zeros_like(linear)
        if self.mode != "position":
            rotation = torch.where(oriented[..., None, None], T[..., :3, :3], model[..., :3, :3])
            twist = se3.log(se3.pose(into_body @ rotation, linear))  # Eq. (30)
            angular = torch.where(oriented.unsqueeze(-1), twist[..., :3], 0.0)
            # The linear part of the twist depends on the orientation, which has no say where positions come first.
            if self.mode == "pose":
                linear = twist[..., 3:]
                # log(exp(-d) exp(V)) = V - J_l^-1(V) d: with J_b alone, right at V = 0, a step near the best fit of
                # sensors that do not fit is no descent, and the estimate would stop short by up to a milliradian.
                body = se3.left_jacobian_inverse(twist) @ body
        residual = Residual(angular, linear, body, usable, oriented)
        position_cost = linear.square().sum((-1, -2))
        cost = position_cost + self.angular_weight**2 * angular.square().sum((-1, -2))
        return _Fit(q, residual, cost, position_cost)

    def _solve(self, residual: Residual, damping: Tensor) -> Tensor:
        if self.mode == "hierarchical":
            return hierarchical_step(residual, damping)
        return least_squares_step(residual, self.angular_weight if self.mode == "pose" else None, damping)

    def _step(self, residual: Residual, damping: Tensor) -> Tensor:
        step = self._solve(residual, damping)
        bounded = step.unflatten(-1, (-1, 3)).abs().amax(-2)
        excess = torch.maximum(bounded[..., :2].amax(-1) / self.bend_step, bounded[..., 2] / self.length_step)
        return step / excess.clamp(min=1.0).unsqueeze(-1)

    def _better(self, trial: _Fit, fit: _Fit) -> Tensor:
        if self.mode != "hierarchical":
            return trial.cost < fit.cost
        # A lower position cost wins; one as good to 0.1 % (or 1 % of the threshold) lets orientation win.
        slack = 1e-3 * fit.position_cost + (0.01 * self.linear_threshold) ** 2
        as_good = trial.position_cost <= fit.position_cost + slack
        return (trial.position_cost < fit.position_cost - slack) | (as_good & (trial.cost < fit.cost))

    def _iterate(self, q_seed: Tensor, evaluate: Callable[[Tensor], _Fit], usable: Tensor) -> Feedback:
        fit = evaluate(q_seed)
        valid = usable.any(-1) & torch.isfinite(fit.cost)
        # Below this the damped normal matrix, of order one, is singular to rounding where sensors leave freedom.
        floor = 32.0 * torch.finfo(fit.cost.dtype).eps
        damping = torch.full_like(fit.cost, max(self.damping, floor))
        within = self._within(fit)
        done = ~valid | (within if self.min_iterations == 0 else torch.zeros_like(within))
        settled = torch.zeros_like(done)
        iterations = torch.zeros_like(done, dtype=torch.int64)
        for k in range(self.max_iterations):
            # Leaving early reads a value, so a traced or compiled step runs all iterations with frozen rows instead.
            if not torch.compiler.is_compiling() and bool(done.all()):
                break
            step = self._step(fit.residual, damping)
            trial = evaluate(fit.q + step)
            take = self._better(trial, fit) & ~done
            iterations = iterations + (~done).to(torch.int64)
            negligible = step.abs().amax(-1) < self.settled_step
            fit = _select(take, trial, fit)
            damping = torch.where(take, (damping * 0.1).clamp(min=floor), damping * 10.0)
            settled = settled | (negligible & ~done)
            within = self._within(fit)
            enough = within if k + 1 >= self.min_iterations else torch.zeros_like(within)
            done = done | settled | enough
        status = torch.where(within, FeedbackStatus.CONVERGED, FeedbackStatus.ITERATION_LIMIT)
        status = torch.where(settled & ~within, FeedbackStatus.SETTLED, status)
        status = torch.where(valid, status, FeedbackStatus.INVALID)
        angular, linear = self._errors(fit)
        return Feedback(fit.q, angular, linear, iterations, status)

    def _errors(self, fit: _Fit) -> tuple[Tensor, Tensor]:
        return fit.residual.angular.norm(dim=-1), fit.residual.linear.norm(dim=-1)

    def _within(self, fit: _Fit) -> Tensor:
        angular, linear = self._errors(fit)
        inside = (linear < self.linear_threshold) & (angular < self.angular_threshold)
        return inside.all(-1)

    def sensitivity(
        self, q_bar: Tensor, pi_hat: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None
    ) -> Tensor:
        """dq_bar/dpi_hat (..., 3 n_b, n_b): how the fixed point of algorithm 2 follows the parameters.

        The fixed point satisfies J_b^T W V_b = 0. Differentiated at a small residual,
        dq_bar/dpi = -(J_b^T W J_b)^-1 J_b^T W (dT/dpi), with dT/dpi the sensors' body twists per unit parameter at
        fixed q: one step of the mode against those twists. Exact where the model fits the sensors.

        Args:
            q_bar: (..., 3 n_b) a converged estimate.
            pi_hat: (..., n_b) m.
            mask: (..., k) bool, sensors used; None for all.
            angular_mask: (..., k) bool, orientations used; None for `mask`.
        """
        self.backbone.check(q_bar, pi_hat)
        # In double precision: a direction that no sensor sees must stay one beside a damping far below any sensor's
        # reach squared, and single precision's rounding would be seen.
        q, pi = q_bar.double(), pi_hat.double()
        X = self._abscissae(pi)
        X_tilde, j = decouple(X, pi)
        _, body = self.backbone.pose_and_body_jacobian(q, pi, X_tilde, j)
        moved = self.backbone.body_parameter_jacobian(q, pi, X, body)
        usable = torch.ones_like(X, dtype=torch.bool) if mask is None else mask
        oriented = usable if angular_mask is None else usable & angular_mask
        twists = -moved.movedim(-1, 0)  # (n_b, ..., k, 6)
        damping = torch.full((), 1e-10, dtype=body.dtype, device=body.device)
        angular = torch.where(oriented.unsqueeze(-1), twists[..., :3], 0.0)
        linear = torch.where(usable.unsqueeze(-1), twists[..., 3:], 0.0)
        return self._solve(Residual(angular, linear, body, usable, oriented), damping).movedim(0, -1).to(q_bar.dtype)


def _check_mask(name: str, mask: Tensor, k: int) -> Tensor:
    if mask.dtype != torch.bool:
        raise DtypeError(f"{name} must be torch.bool, got {mask.dtype}")
    if mask.shape[-1:] != (k,):
        raise ShapeError(f"{name} must have shape (..., {k}), got {tuple(mask.shape)}")
    return mask


def _select(take: Tensor, new: _Fit, old: _Fit) -> _Fit:
    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(take[(..., *(None,) * (a.dim() - take.dim()))], a, b)

    r, s = new.residual, old.residual
    residual = Residual(
        choose(r.angular, s.angular), choose(r.linear, s.linear), choose(r.body, s.body), s.usable, s.oriented
    )
    return _Fit(
        choose(new.q, old.q), residual, choose(new.cost, old.cost), choose(new.position_cost, old.position_cost)
    )
