"""Algorithm 2: the model's configuration from the poses of any number of sensors, batched, row by row converged."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.counted import check_masks, counted
from apcc_torch.estimation.feedback import Feedback, Inference, status_of
from apcc_torch.estimation.fit import Problem, evaluate
from apcc_torch.estimation.fixed_point import fixed_point_slope
from apcc_torch.estimation.implicit import attached
from apcc_torch.estimation.iteration import far_off, iterate, unseen
from apcc_torch.estimation.state_feedback_settings import StateFeedbackSettings
from apcc_torch.estimation.step import row_weights
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.model.sensor_kinds import SensorKinds
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import Setting, aligned, resolved
from apcc_torch.shapes import batch_shape, broadcast, check_finite, check_same, check_tensor

# Of its rest length, the least that a section keeps. A shorter one is never inferred: through nothing lies a section
# turned inside out, of negative length and bent the other way round, with the very same tip.
SHORTEST = 0.01


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
    angular_weight, and none to the seed: of rows that ended CONVERGED, SETTLED or MISFIT. A row at ITERATION_LIMIT is a
    constant, an INVALID one is its seed. Differentiating the gradient again raises GradientError.

    No section is ever inferred shorter than a share of its rest length: one turned inside out, bent the other way, has
    the same tip. A seed that is far off, or has such a section, first tries the bends that the sensors' orientations
    tell, and keeps them where they fit better.

    Args:
        backbone: The model.
        abscissae: (..., k) material abscissae of the sensors, m, increasing, S_s of Eq. (22).
        *settings, **changes: See `StateFeedbackSettings`.
        kinds: What the sensors measure; None for poses. Positions count, and the orientations of poses: one from an
            inertial unit does not, for nothing here knows how its heading drifts.

    Raises:
        ValueRangeError: The sensor set is empty, not sorted or negative, or a setting is out of range.

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25]).double()
        >>> q, ends = torch.tensor([0.3, 0.1, 0.0, -0.4, 0.2, 0.01]).double(), L0.cumsum(0)
        >>> feedback = StateFeedback(backbone, ends, mode="pose")
        >>> estimate = feedback(torch.zeros(6).double(), L0, backbone.pose(q, L0, *decouple(ends, L0)))
        >>> estimate.q_bar.round(decimals=3) + 0.0
        tensor([ 0.3000,  0.1000,  0.0000, -0.4000,  0.2000,  0.0100],
               dtype=torch.float64)
    """

    settings_type = StateFeedbackSettings
    abscissae: Tensor
    mode: str
    gradient: str
    angular_weight: Setting
    max_iterations: int
    min_iterations: int
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
        *settings: Any,
        kinds: SensorKinds | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        check_tensor("abscissae", abscissae, (None,))
        check_finite("abscissae", abscissae)
        if abscissae.shape[-1] == 0:
            raise ValueRangeError("abscissae must name at least one sensor, got an empty set")
        if not (holds(abscissae.diff(dim=-1) > 0) and holds(abscissae >= 0)):
            raise ValueRangeError(f"abscissae must be increasing and not negative, got {abscissae.tolist()}")
        self.backbone = backbone
        self.kinds = kinds
        self.hold(resolved(StateFeedbackSettings, settings, changes))
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
            T: (..., k, 4, 4) measured sensor poses, world frame. Non-finite sensors count as masked. A finite one that
                counts and is no pose, be it of zeros or scaled, makes its row INVALID.
            mask: (..., k) bool, False for a sensor to leave out; None for all.
            angular_mask: (..., k) bool, False for a sensor whose orientation to leave out; None for `mask`.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        k = self.abscissae.shape[-1]
        self.backbone.check(q_seed, pi_hat)
        check_tensor("T", T, (k, 4, 4))
        check_same(q_seed=q_seed, T=T)
        masks = check_masks(k, mask, angular_mask)
        batch_shape(q_seed=(q_seed, 1), pi_hat=(pi_hat, 1), T=(T, 3), **masks)
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
        pi_hat, problem = self.problem(q_seed.shape[:-1], pi_hat, T, mask, angular_mask)
        q_seed = q_seed.expand(*pi_hat.shape[:-1], q_seed.shape[-1])
        return Inference(self._infer(q_seed, pi_hat, problem), pi_hat, problem)

    def problem(
        self,
        batch: torch.Size,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> tuple[Tensor, Problem]:
        """pi_hat and what is to be fitted, both of the leading shape that `batch` has with the arguments of `infer`."""
        usable, oriented = self.used(T, mask, angular_mask)
        T = T if self.kinds is None else self.kinds.filled(T)
        others = pi_hat.shape[:-1], oriented.shape[:-1]
        if any(shape != batch for shape in others):
            batch = broadcast(batch, *others)
        usable, oriented, pi_hat = (v.expand(*batch, v.shape[-1]) for v in (usable, oriented, pi_hat))
        lengths = (pi_hat > 0.0).all(-1, keepdim=True)  # of no length there is nothing to bend
        return pi_hat, self._problem(pi_hat, T, usable & lengths, oriented & lengths)

    def judged(
        self,
        q_bar: Tensor,
        pi_hat: Tensor,
        problem: Problem,
        step: Tensor,
        misfit: Tensor,
        told: Tensor | None = None,
        untold: Tensor | None = None,
    ) -> Inference:
        """What the sensors say of a q_bar (..., n) from elsewhere, of which one step was taken.

        Args:
            q_bar, pi_hat, problem: As they are now.
            step: (...) the largest part of that step, rad and m: with one that is not negligible a row has not settled.
            misfit: (...) bool, rows that are a MISFIT where they settle.
            told: (...) bool, rows of which a sensor tells that does not count here; None for none.
            untold: (...) bool, rows that are UNTOLD where they are no MISFIT; None for none.
        """
        fit = evaluate(self.backbone, self.mode, q_bar, problem)
        angular, linear = fit.errors()
        within = (linear < aligned(self.linear_threshold, 1)) & (angular < aligned(self.angular_threshold, 1))
        seen = problem.usable.any(-1) if told is None else problem.usable.any(-1) | told
        valid = seen & torch.isfinite(q_bar).all(-1)
        settled, iterations = step < self.settled_step, torch.ones_like(valid, dtype=torch.int64)
        status = status_of(iterations, within.all(-1), settled, far_off(fit, problem) | misfit, valid, untold)
        return Inference(Feedback(q_bar, angular, linear, iterations, status), pi_hat, problem)

    def used(self, T: Tensor, mask: Tensor | None = None, angular_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Which sensors, and which orientations, count here: two bool (..., k). Arguments as `forward`.

        None of a row counts in which one that does is no pose: what else such a source says is as wrong.
        """
        usable, oriented = counted(T, self.kinds, mask, angular_mask)
        return usable, oriented if self.kinds is None else oriented & usable

    def _problem(self, pi_hat: Tensor, T: Tensor, usable: Tensor, oriented: Tensor) -> Problem:
        # What is left out is measured where the model has it: it pulls nowhere, and nothing non-finite enters.
        T = torch.where(usable[..., None, None], T, 0.0)
        points = self.backbone.material_points(pi_hat, *located(self._abscissae(pi_hat).expand_as(usable), pi_hat))
        weights = self._weights(usable, oriented, pi_hat.dtype)
        return Problem(T[..., :3, :3], T[..., :3, 3], points, usable, oriented, weights)

    def _abscissae(self, like: Tensor) -> Tensor:
        return self.abscissae.to(dtype=like.dtype, device=like.device)

    def _weights(self, usable: Tensor, oriented: Tensor, dtype: torch.dtype) -> Tensor:
        if self.mode == "position":
            oriented = torch.zeros_like(oriented)
        # In the arm's dtype from the start: a bool times a number would be a single-precision one.
        angular = oriented.to(dtype) * (aligned(self.angular_weight, 1) if self.mode == "pose" else 1.0)
        return row_weights(angular, usable, dtype)

    def _infer(self, q_seed: Tensor, pi_hat: Tensor, problem: Problem) -> Feedback:
        lowest = self._lowest(pi_hat)
        if self.gradient == "implicit" and torch.is_grad_enabled():
            with torch.no_grad():
                outcome = iterate(self.backbone, self, q_seed, problem, lowest)
            outcome = outcome._replace(fit=attached(self.backbone, self.mode, outcome, q_seed, problem))
        else:
            outcome = iterate(self.backbone, self, q_seed, problem, lowest)
        fit, within, settled, valid, iterations = outcome
        status = status_of(iterations, within, settled, far_off(fit, problem), valid)
        q_bar = torch.where(valid.unsqueeze(-1), fit.q, q_seed)
        return Feedback(q_bar, *fit.errors(), iterations, status)

    def _lowest(self, pi_hat: Tensor) -> Tensor:
        """The lowest q (..., n): sections keep a share of their rest length, and nothing else is bounded."""
        coordinates = self.backbone.coordinates
        free = torch.full_like(coordinates.on_elongations(pi_hat), -torch.inf)
        return coordinates.with_elongations(free, (SHORTEST - 1.0) * pi_hat)

    def sensitivity(
        self,
        q_bar: Tensor,
        pi_hat: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
        T: Tensor | None = None,
    ) -> Tensor:
        """dq_bar/dpi_hat (..., n, n_b): how the fixed point of algorithm 2 follows the parameters.

        The fixed point's exact derivative in closed form, see `fixed_point`: with the curvature that the residual adds,
        which the steps of Eq. (31) lack. Where second derivatives are not positive definite on what the sensors see, no
        fixed point attracts, and there is no derivative: such a row has that of the steps, which is exact at no
        residual, dq_bar/dpi = -(J_b^T W J_b)^-1 J_b^T W dT/dpi.

        Args:
            q_bar: (..., n) a converged estimate.
            pi_hat: (..., n_b) m.
            mask: (..., k) bool, sensors used; None for all.
            angular_mask: (..., k) bool, orientations used; None for `mask`.
            T: (..., k, 4, 4) measured poses that q_bar was inferred from; None for poses that the model fits.
        """
        self.backbone.check(q_bar, pi_hat)
        k = self.abscissae.shape[-1]
        leading = {"q_bar": (q_bar, 1), "pi_hat": (pi_hat, 1), "abscissae": (self.abscissae, 1)}
        leading |= check_masks(k, mask, angular_mask)
        if T is not None:
            leading["T"] = (check_tensor("T", T, (k, 4, 4)), 3)
        batch = batch_shape(**leading)
        q, pi = q_bar.expand(*batch, q_bar.shape[-1]), pi_hat.expand(*batch, pi_hat.shape[-1])
        if T is None:
            q_, pi_ = q.double(), pi.double()
            T = self.backbone.pose(q_, pi_, *located(self._abscissae(pi_).expand(*batch, k), pi_))
        usable, oriented = (v.expand(*batch, k) for v in self.used(T, mask, angular_mask))
        return self._slope(q, pi, T, usable, oriented)

    def chain_and_sensitivity(self, inference: Inference, batch: torch.Size) -> tuple[Placed, Tensor]:
        """The arm's chain at q_bar and `sensitivity` (..., n, n_b) there, from one pass.

        Args:
            inference: From `infer`.
            batch: Leading shape of the results; that of the inference broadcasts to it.
        """
        feedback, pi_hat, problem = inference
        q = feedback.q_bar.expand(*batch, feedback.q_bar.shape[-1])
        if q.dtype != torch.float64:
            T = se3.pose(problem.rotation, problem.position)
            slope = self._slope(feedback.q_bar, pi_hat, T, problem.usable, problem.oriented)
            return self.backbone.chain(q, pi_hat), slope
        chain = self.backbone.chain_to(q, problem.points.with_tip(pi_hat))
        X, seen = self._abscissae(pi_hat), chain.at(slice(-1))
        return chain.at(-1), fixed_point_slope(self.backbone, self.mode, feedback.q_bar, pi_hat, X, problem, seen)

    def unseen(self, inference: Inference) -> Tensor:
        """(...) int64 how many directions of q the sensors that count do not see: there q_bar stays near the seed.

        Args:
            inference: From `infer`.
        """
        q, problem = inference.feedback.q_bar, inference.problem
        body = self.backbone.chain_to(q, problem.points).body_jacobian()
        return unseen(body, problem.weights)

    def _slope(self, q: Tensor, pi: Tensor, T: Tensor, usable: Tensor, oriented: Tensor) -> Tensor:
        # In double precision: a direction that no sensor sees must stay one beside a damping far below any sensor's
        # reach squared, and single precision's rounding would be seen.
        problem = self._problem(pi.double(), T.double(), usable, oriented)
        chain = self.backbone.chain_to(q.double(), problem.points)
        X = self._abscissae(chain.tip)
        return fixed_point_slope(self.backbone, self.mode, q.double(), pi.double(), X, problem, chain).to(q.dtype)
