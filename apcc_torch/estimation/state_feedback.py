"""Algorithm 2: the model's configuration from the poses of any number of sensors, batched, row by row converged."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.fit import Fit, Problem, evaluate, select
from apcc_torch.estimation.step import Residual, hierarchical_step, least_squares_step, row_weights
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import located
from apcc_torch.model.backbone import MaterialPoints, PCCBackbone
from apcc_torch.model.chain import Chain, body_jacobian, last_chain
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


class Inference(NamedTuple):
    """Algorithm 2's result with what `StateFeedback.followed` needs of it.

    feedback: The result.
    pi_hat: (..., n_b) the parameters it was inferred with, m.
    problem: The sensors.
    """

    feedback: Feedback
    pi_hat: Tensor
    problem: Problem


class _Scored(NamedTuple):
    """A fit and how good it is."""

    fit: Fit
    cost: Tensor  # (...) m^2
    position_cost: Tensor  # (...) m^2
    within: Tensor  # (...) bool, both thresholds are met


class _Step(NamedTuple):
    """A step and what it promises."""

    step: Tensor  # (..., n)
    twist: Tensor  # (..., k, 6) after the step, to first order
    negligible: Tensor  # (...) bool


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
        settled_step: A step with every entry (rad, m) below this is the row's last.

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
        settled_step: float = 5e-6,
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
        return self.infer(q_seed, pi_hat, T, mask, angular_mask).feedback

    def infer(
        self,
        q_seed: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> Inference:
        """`forward`, with what it knows at its end; arguments and errors as there."""
        k = self.abscissae.shape[-1]
        self.backbone.check(q_seed, pi_hat)
        check_tensor("T", T, (k, 4, 4))
        check_same(q_seed=q_seed, T=T)
        usable, oriented = self.used(T, mask, angular_mask)
        batch = batch_shape(q_seed=(q_seed, 1), pi_hat=(pi_hat, 1), sensors=(oriented, 1))
        usable, oriented = usable.expand(*batch, k), oriented.expand(*batch, k)
        pi_hat = pi_hat.expand(*batch, pi_hat.shape[-1])
        # What is left out is measured where the model has it: it pulls nowhere, and nothing non-finite enters.
        T = torch.where(usable[..., None, None], T, 0.0)
        problem = Problem(
            T[..., :3, :3],
            T[..., :3, 3],
            self.backbone.material_points(pi_hat, *located(self._abscissae(pi_hat).expand(*batch, k), pi_hat)),
            usable,
            oriented,
            self._weights(usable, oriented, pi_hat.dtype),
        )
        return Inference(self._iterate(q_seed.expand(*batch, q_seed.shape[-1]), problem), pi_hat, problem)

    def used(self, T: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Which sensors, and which orientations, count: two bool (..., k). Arguments as `forward`."""
        k = self.abscissae.shape[-1]
        usable = torch.isfinite(T).flatten(-2).all(-1)
        given = {"T": (usable, 1)}
        for name, chosen in {"mask": mask, "angular_mask": angular_mask}.items():
            if chosen is not None:
                given[name] = (_check_mask(name, chosen, k), 1)
        if len(given) > 1:
            batch_shape(**given)
        usable = usable if mask is None else usable & mask
        return usable, usable if angular_mask is None else usable & angular_mask

    def _abscissae(self, like: Tensor) -> Tensor:
        return self.abscissae.to(dtype=like.dtype, device=like.device)

    def _weights(self, usable: Tensor, oriented: Tensor, dtype: torch.dtype) -> Tensor:
        if self.mode == "position":
            oriented = torch.zeros_like(oriented)
        return row_weights(oriented * (self.angular_weight if self.mode == "pose" else 1.0), usable, dtype)

    def _score(self, fit: Fit) -> _Scored:
        angular, linear = fit.squares()
        cost = torch.add(linear, angular, alpha=self.angular_weight**2).sum(-1)
        position_cost = linear.sum(-1) if self.mode == "hierarchical" else cost
        inside = (linear < self.linear_threshold**2) & (angular < self.angular_threshold**2)
        return _Scored(fit, cost, position_cost, inside.all(-1))

    def _solve(self, residual: Residual, damping: Tensor) -> Tensor:
        return (hierarchical_step if self.mode == "hierarchical" else least_squares_step)(residual, damping)

    def _step(self, fit: Fit, weights: Tensor, damping: Tensor, limits: Tensor) -> _Step:
        body = fit.body
        if self.mode == "pose":
            # log(exp(-d) exp(V)) = V - J_l^-1(V) d: with J_b alone, right at V = 0, a step near the best fit of sensors
            # that do not fit is no descent, and the estimate would stop short by up to a milliradian.
            body = se3.left_jacobian_inverse_times(fit.twist, fit.k, body)
        twist = fit.twist.unsqueeze(-1)
        step = self._solve(Residual(twist, body, weights), damping)
        size = step.abs()
        step = step / (size / limits).amax((-1, -2), keepdim=True).clamp(min=1.0)
        after = torch.where(weights > 0.0, twist - body @ step.unsqueeze(-3), 0.0)
        return _Step(step.squeeze(-1), after.squeeze(-1), size.amax((-1, -2)) < self.settled_step)

    def _better(self, trial: _Scored, best: _Scored) -> Tensor:
        if self.mode != "hierarchical":
            return trial.cost < best.cost
        # A lower position cost wins; one as good to 0.1 % (or 1 % of the threshold) lets orientation win.
        slack = 1e-3 * best.position_cost + (0.01 * self.linear_threshold) ** 2
        as_good = trial.position_cost <= best.position_cost + slack
        return (trial.position_cost < best.position_cost - slack) | (as_good & (trial.cost < best.cost))

    def _chosen(self, take: Tensor, trial: _Scored, best: _Scored) -> _Scored:
        cost = torch.where(take, trial.cost, best.cost)
        position_cost = cost
        if self.mode == "hierarchical":
            position_cost = torch.where(take, trial.position_cost, best.position_cost)
        within = torch.where(take, trial.within, best.within)
        return _Scored(select(take, trial.fit, best.fit), cost, position_cost, within)

    def _iterate(self, q_seed: Tensor, problem: Problem) -> Feedback:
        best = self._score(evaluate(self.backbone, self.mode, q_seed, problem))
        valid = problem.usable.any(-1) & torch.isfinite(best.cost)
        # Below this the damped normal matrix, of order one, is singular to rounding where sensors leave freedom.
        floor = 32.0 * torch.finfo(best.cost.dtype).eps
        damping = torch.full_like(best.cost, max(self.damping, floor))
        limits = self._limits(q_seed)
        done = ~valid
        if self.min_iterations == 0:
            done = done | best.within
        settled = torch.zeros_like(done)
        iterations = torch.zeros_like(done, dtype=torch.int64)
        for k in range(self.max_iterations):
            # Leaving early reads a value, so a traced or compiled step runs all iterations with frozen rows instead.
            if not torch.compiler.is_compiling() and bool(done.all()):
                break
            live, last = ~done, k + 1 >= self.min_iterations
            step = self._step(best.fit, problem.weights, damping, limits)
            negligible = step.negligible & live
            # A negligible step that is a row's last is taken on trust, and what it leaves is what it promises: only
            # the pose's twist, whose derivative is exact, keeps that promise to second order.
            trusted = negligible if last and self.mode == "pose" else torch.zeros_like(live)
            trial = Fit(best.fit.q + step.step, step.twist, best.fit.k, best.fit.body)
            if torch.compiler.is_compiling() or not bool((done | trusted).all()):
                fit = evaluate(self.backbone, self.mode, trial.q, problem)
                trial = fit._replace(twist=torch.where(trusted[..., None, None], step.twist, fit.twist))
            scored = self._score(trial)
            take = (self._better(scored, best) | trusted) & live
            iterations = iterations + live
            settled = settled | negligible
            best = self._chosen(take, scored, best)
            damping = torch.where(take, 0.1 * damping, 10.0 * damping).clamp(min=floor)
            if last:
                done = done | settled | best.within
        status = torch.where(best.within, FeedbackStatus.CONVERGED, FeedbackStatus.ITERATION_LIMIT)
        status = torch.where(settled & ~best.within, FeedbackStatus.SETTLED, status)
        status = torch.where(valid, status, FeedbackStatus.INVALID)
        return Feedback(best.fit.q, *best.fit.errors(), iterations, status)

    def _limits(self, like: Tensor) -> Tensor:
        """(n, 1) largest change of each configuration variable in one step."""
        bend = torch.full((self.backbone.n_sections, 2), self.bend_step, dtype=like.dtype, device=like.device)
        return torch.nn.functional.pad(bend, (0, 1), value=self.length_step).reshape(-1, 1)

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
        usable = torch.ones_like(self.abscissae, dtype=torch.bool) if mask is None else mask
        oriented = usable if angular_mask is None else usable & angular_mask
        batch = batch_shape(q_bar=(q_bar, 1), pi_hat=(pi_hat, 1), sensors=(oriented, 1))
        # In double precision: a direction that no sensor sees must stay one beside a damping far below any sensor's
        # reach squared, and single precision's rounding would be seen.
        q, pi = (v.double().expand(*batch, v.shape[-1]) for v in (q_bar, pi_hat))
        X = self._abscissae(pi)
        points = self.backbone.material_points(pi, *located(X.expand(*batch, X.shape[-1]), pi))
        body = body_jacobian(self.backbone.chain_to(q, points), points.fraction)
        return self._followed(q, pi, points, body, self._weights(usable, oriented, q.dtype)).to(q_bar.dtype)

    def followed(self, inference: Inference, batch: torch.Size) -> tuple[Chain, Tensor]:
        """The arm's chain at q_bar and `sensitivity` (..., 3 n_b, n_b) there, from one pass.

        Args:
            inference: From `infer`.
            batch: Leading shape of the results; that of the inference broadcasts to it.
        """
        feedback, pi_hat, problem = inference
        q_bar = feedback.q_bar
        q = q_bar.expand(*batch, q_bar.shape[-1])
        if q.dtype != torch.float64:
            return self.backbone.chain(q, pi_hat), self.sensitivity(q_bar, pi_hat, problem.usable, problem.oriented)
        points = self.backbone.with_tip(problem.points, pi_hat)
        chain = self.backbone.chain_to(q, points)
        body = body_jacobian(chain, points.fraction)[..., :-1, :, :]
        return last_chain(chain), self._followed(q_bar, pi_hat, problem.points, body, problem.weights)

    def _followed(self, q: Tensor, pi: Tensor, points: MaterialPoints, body: Tensor, weights: Tensor) -> Tensor:
        moved = self.backbone.parameter_columns(q, pi, self._abscissae(pi), points, body)
        damping = torch.full((), 1e-10, dtype=body.dtype, device=body.device)
        return -self._solve(Residual(moved, body, weights), damping)


def _check_mask(name: str, mask: Tensor, k: int) -> Tensor:
    if mask.dtype != torch.bool:
        raise DtypeError(f"{name} must be torch.bool, got {mask.dtype}")
    if mask.shape[-1:] != (k,):
        raise ShapeError(f"{name} must have shape (..., {k}), got {tuple(mask.shape)}")
    return mask
