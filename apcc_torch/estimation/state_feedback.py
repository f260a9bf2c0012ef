"""Algorithm 2: the model's configuration from the poses of any number of sensors, batched, row by row converged."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.feedback import Feedback, FeedbackStatus, Inference
from apcc_torch.estimation.fit import Problem
from apcc_torch.estimation.implicit import attached
from apcc_torch.estimation.iteration import Rules, iterate
from apcc_torch.estimation.step import Residual, damped_step, row_weights
from apcc_torch.model.abscissae import MaterialPoints, located
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.modes import holds
from apcc_torch.part import Part, check_settings, hold, hold_rows
from apcc_torch.settings import Setting, aligned
from apcc_torch.shapes import batch_shape, check_finite, check_same, check_tensor

MODES = ("position", "pose", "hierarchical")
GRADIENTS = ("implicit", "unrolled")


class StateFeedback(Part):
    """Decoupled state feedback. Algorithm 2, Eqs. (27)-(32), remark 4 [Dalenberg].

    Each iteration is a Levenberg-Marquardt step with a bound on its length: plain Gauss-Newton, Eq. (31), diverges on
    strongly bent shapes, and the stacked Jacobian is not square. A step that does not lower the cost is refused and
    the damping raised; rows that are done freeze while others go on. The loop runs while either error is above its
    threshold (the printed algorithm joins them with "&", which stops at the first).

    Modes: "position" fits the sensors' positions only, Eq. (32); "pose" fits Eq. (30) with `angular_weight` metres to
    the radian (the paper's is 1); "hierarchical" fits positions first and orientations in the null space that the
    positions leave.

    Each number may also be a tensor (...), one a row, except the numbers of iterations.

    Gradients of q_bar and of the errors are those of the fixed point at q_bar, with respect to pi_hat, T, abscissae and
    angular_weight, and none to the seed: of rows that ended CONVERGED or SETTLED. A row at ITERATION_LIMIT is a
    constant, an INVALID one is its seed. Differentiating the gradient again raises GradientError.

    Args:
        backbone: The model.
        abscissae: (..., k) material abscissae of the sensors, m, increasing, S_s of Eq. (22).
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
        gradient: "implicit", see above, or "unrolled": reverse-mode gradients go through every step of the iteration.

    Raises:
        ValueRangeError: The sensor set is empty, not sorted or negative, or a setting is out of range.
    """

    abscissae: Tensor
    angular_weight: Setting
    linear_threshold: Setting
    angular_threshold: Setting
    bend_step: Setting
    length_step: Setting
    damping: Setting
    settled_step: Setting

    def __init__(
        self,
        backbone: KinematicModel,
        abscissae: Tensor,
        mode: str = "pose",
        angular_weight: Setting = 1.0,
        max_iterations: int = 7,
        min_iterations: int = 1,
        linear_threshold: Setting = 1e-4,
        angular_threshold: Setting = 5e-3,
        bend_step: Setting = 0.6,
        length_step: Setting = 0.1,
        damping: Setting = 1e-8,
        settled_step: Setting = 5e-6,
        gradient: str = "implicit",
    ) -> None:
        super().__init__()
        check_tensor("abscissae", abscissae, (None,))
        check_finite("abscissae", abscissae)
        if abscissae.shape[-1] == 0:
            raise ValueRangeError("abscissae must name at least one sensor, got an empty set")
        if not (holds(abscissae.diff(dim=-1) > 0) and holds(abscissae >= 0)):
            raise ValueRangeError(f"abscissae must be increasing and not negative, got {abscissae.tolist()}")
        if mode not in MODES:
            raise ValueRangeError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
        if gradient not in GRADIENTS:
            raise ValueRangeError(f"gradient must be one of {', '.join(GRADIENTS)}, got {gradient!r}")
        settings = {
            "angular_weight": angular_weight,
            "linear_threshold": linear_threshold,
            "angular_threshold": angular_threshold,
            "bend_step": bend_step,
            "length_step": length_step,
            "damping": damping,
        }
        check_settings(**settings, max_iterations=max_iterations)
        if not 0 <= min_iterations <= max_iterations:
            raise ValueRangeError(f"min_iterations must be between 0 and max_iterations, got {min_iterations}")
        self.backbone = backbone
        self.mode = mode
        self.gradient = gradient
        self.max_iterations = max_iterations
        self.min_iterations = min_iterations
        hold(self, **settings, settled_step=settled_step)
        hold_rows(self, abscissae=(abscissae, 1))

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
            q_seed: (..., n) first guess, the previous q_bar (remark 4).
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
        leading = {"q_seed": (q_seed, 1), "pi_hat": (pi_hat, 1), "T": (T, 3)}
        for name, given in {"mask": mask, "angular_mask": angular_mask}.items():
            if given is not None:
                leading[name] = (_check_mask(name, given, k), 1)
        batch_shape(**leading)
        return self.infer(q_seed, pi_hat, T, mask, angular_mask).feedback

    def infer(
        self,
        q_seed: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> Inference:
        """`forward`, with what it knows at its end; only the masks are checked here."""
        usable, oriented = self.used(T, mask, angular_mask)
        batch, *others = q_seed.shape[:-1], pi_hat.shape[:-1], oriented.shape[:-1]
        if any(shape != batch for shape in others):
            batch = torch.broadcast_shapes(batch, *others)
        usable, oriented, pi_hat, q_seed = (v.expand(*batch, v.shape[-1]) for v in (usable, oriented, pi_hat, q_seed))
        # What is left out is measured where the model has it: it pulls nowhere, and nothing non-finite enters.
        T = torch.where(usable[..., None, None], T, 0.0)
        problem = Problem(
            T[..., :3, :3],
            T[..., :3, 3],
            self.backbone.material_points(pi_hat, *located(self._abscissae(pi_hat).expand_as(usable), pi_hat)),
            usable,
            oriented,
            self._weights(usable, oriented, pi_hat.dtype),
        )
        return Inference(self._infer(q_seed, problem), pi_hat, problem)

    def used(self, T: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Which sensors, and which orientations, count: two bool (..., k). Arguments as `forward`."""
        usable = torch.isfinite(T).flatten(-2).all(-1)
        if mask is not None:
            usable = usable & _check_mask("mask", mask, usable.shape[-1])
        if angular_mask is None:
            return usable, usable
        return usable, usable & _check_mask("angular_mask", angular_mask, usable.shape[-1])

    def _abscissae(self, like: Tensor) -> Tensor:
        return self.abscissae.to(dtype=like.dtype, device=like.device)

    def _weights(self, usable: Tensor, oriented: Tensor, dtype: torch.dtype) -> Tensor:
        if self.mode == "position":
            oriented = torch.zeros_like(oriented)
        # In the arm's dtype from the start: a bool times a number would be a single-precision one.
        angular = oriented.to(dtype) * (aligned(self.angular_weight, 1) if self.mode == "pose" else 1.0)
        return row_weights(angular, usable, dtype)

    def _rules(self) -> Rules:
        return Rules(
            self.mode,
            self.angular_weight,
            self.max_iterations,
            self.min_iterations,
            self.linear_threshold,
            self.angular_threshold,
            self.bend_step,
            self.length_step,
            self.damping,
            self.settled_step,
        )

    def _infer(self, q_seed: Tensor, problem: Problem) -> Feedback:
        if self.gradient == "implicit" and torch.is_grad_enabled():
            with torch.no_grad():
                outcome = iterate(self.backbone, self._rules(), q_seed, problem)
            outcome = outcome._replace(fit=attached(self.backbone, self.mode, outcome, q_seed, problem))
        else:
            outcome = iterate(self.backbone, self._rules(), q_seed, problem)
        fit, within, settled, valid, iterations = outcome
        status = torch.full_like(iterations, FeedbackStatus.ITERATION_LIMIT)
        status = status.masked_fill(settled, FeedbackStatus.SETTLED).masked_fill(within, FeedbackStatus.CONVERGED)
        return Feedback(fit.q, *fit.errors(), iterations, status.masked_fill(~valid, FeedbackStatus.INVALID))

    def sensitivity(
        self, q_bar: Tensor, pi_hat: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None
    ) -> Tensor:
        """dq_bar/dpi_hat (..., n, n_b): how the fixed point of algorithm 2 follows the parameters.

        The fixed point satisfies J_b^T W V_b = 0. Differentiated at a small residual,
        dq_bar/dpi = -(J_b^T W J_b)^-1 J_b^T W (dT/dpi), with dT/dpi the sensors' body twists per unit parameter at
        fixed q: one step of the mode against those twists. Exact where the model fits the sensors.

        Args:
            q_bar: (..., n) a converged estimate.
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
        body = self.backbone.chain_to(q, points).body_jacobian()
        return self._followed(q, pi, points, body, self._weights(usable, oriented, q.dtype)).to(q_bar.dtype)

    def followed(self, inference: Inference, batch: torch.Size) -> tuple[Placed, Tensor]:
        """The arm's chain at q_bar and `sensitivity` (..., n, n_b) there, from one pass.

        Args:
            inference: From `infer`.
            batch: Leading shape of the results; that of the inference broadcasts to it.
        """
        feedback, pi_hat, problem = inference
        q_bar = feedback.q_bar
        q = q_bar.expand(*batch, q_bar.shape[-1])
        if q.dtype != torch.float64:
            return self.backbone.chain(q, pi_hat), self.sensitivity(q_bar, pi_hat, problem.usable, problem.oriented)
        points = problem.points.with_tip(pi_hat)
        chain = self.backbone.chain_to(q, points)
        body = chain.body_jacobian()[..., :-1, :, :]
        return chain.last(), self._followed(q_bar, pi_hat, problem.points, body, problem.weights)

    def _followed(self, q: Tensor, pi: Tensor, points: MaterialPoints, body: Tensor, weights: Tensor) -> Tensor:
        moved = self.backbone.parameter_columns(q, pi, self._abscissae(pi), points, body)
        damping = torch.full((), 1e-10, dtype=body.dtype, device=body.device)
        return -damped_step(self.mode, Residual(moved, body, weights), damping)


def _check_mask(name: str, mask: Tensor, k: int) -> Tensor:
    if mask.dtype != torch.bool:
        raise DtypeError(f"{name} must be torch.bool, got {mask.dtype}")
    if mask.shape[-1:] != (k,):
        raise ShapeError(f"{name} must have shape (..., {k}), got {tuple(mask.shape)}")
    return mask
