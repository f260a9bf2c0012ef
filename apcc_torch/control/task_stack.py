"""Several tasks at once: weighted least squares among tasks of one level, null spaces between levels.

With the rows of level k stacked and weighted as J_k qdot = v_k, N_0 = I and ^+ the damped pseudo-inverse,

    qdot_k = qdot_{k-1} + (J_k N_{k-1})^+ (v_k - J_k qdot_{k-1}),    N_k = N_{k-1} - V_k V_k^T,

where V_k are the directions that J_k N_{k-1} moves, by more than the damping. What all levels leave free follows a
descent direction, qdot = qdot_last + (N_{last-1} - (J_last N_{last-1})^+ J_last N_{last-1}) descent, so that one task
of the tip's position is Eq. (16) [Dalenberg]. Between levels that projection would not do: what a damped one lets
through, a lower level would amplify until its own task is met.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from apcc_torch.control.bounds import RateBounds, eased, solved_within
from apcc_torch.control.tasks import JointedModel, Task, TaskRate, TaskTarget, weighted_rows
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.abscissae import decouple
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import check_positive


class TaskStack(Part):
    """Tasks with weights and priorities, solved together; see the module's head.

    The model may be any arm whose points have poses and body Jacobians; a point is found by its material abscissa.

    Args:
        tasks: The tasks, in any order of levels.
        damping: Of every pseudo-inverse, in the unit of the weighted rows, m per rad; 0 for the exact one.
        coordinate_weights: (n,) cost of each coordinate's rate: a coordinate of weight 4 moves as if its unit were half
            as long. None for ones.

    Raises:
        ValueRangeError: There is no task, or a setting is out of range.
    """

    damping: Setting
    coordinate_weights: Tensor | None

    def __init__(
        self, tasks: Sequence[Task], damping: Setting = 1e-3, coordinate_weights: Tensor | None = None
    ) -> None:
        super().__init__()
        if not tasks:
            raise ValueRangeError("tasks must hold at least one task")
        check_setting("damping", damping, zero=True)
        hold_numbers(self, damping=damping)
        if coordinate_weights is not None:
            check_positive("coordinate_weights", coordinate_weights)
        hold_rows(self, coordinate_weights=(coordinate_weights, 1))
        self.tasks = nn.ModuleList(tasks)

    @property
    def levels(self) -> list[list[int]]:
        """The tasks' indices, level by level, the first priority first."""
        of_level: dict[int, list[int]] = {}
        for i, task in enumerate(self._tasks()):
            of_level.setdefault(task.level, []).append(i)
        return [of_level[level] for level in sorted(of_level)]

    def _tasks(self) -> list[Task]:
        return [task for task in self.tasks if isinstance(task, Task)]

    def poses(self, model: JointedModel, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., k, 4, 4) and body Jacobians (..., k, 6, n) of the tasks' points, from one pass."""
        total = L0.sum(-1, keepdim=True)
        at = [task.abscissa for task in self._tasks()]
        X = torch.cat([total if X is None else torch.full_like(total, X) for X in at], dim=-1)
        X_tilde, j = decouple(X, L0)
        tip = torch.tensor([X is None for X in at], device=L0.device)
        # Rounding must not put the tip just before the tip.
        X_tilde, j = torch.where(tip, 1.0, X_tilde), torch.where(tip, L0.shape[-1] - 1, j)
        return model.pose_and_body_jacobian(q, L0, X_tilde, j)

    def rates(
        self,
        model: JointedModel,
        q: Tensor,
        L0: Tensor,
        targets: Sequence[TaskTarget],
        seen: Sequence[Tensor | None] | None = None,
    ) -> list[TaskRate]:
        """What every task asks for.

        Args:
            model: The arm.
            q: (..., n) its configuration.
            L0: (..., n_b) rest lengths, m.
            targets: One a task.
            seen: The measured pose (..., 4, 4) of every task's point, None where the model's is to be taken.

        Raises:
            ShapeError: There are not as many targets, or measured poses, as tasks.
        """
        return self.asked(*self.poses(model, q, L0), targets, seen)

    def asked(
        self, T: Tensor, J_b: Tensor, targets: Sequence[TaskTarget], seen: Sequence[Tensor | None] | None = None
    ) -> list[TaskRate]:
        """`rates` where the poses (..., k, 4, 4) and body Jacobians (..., k, 6, n) of the points are known."""
        tasks = self._tasks()
        seen = [None] * len(tasks) if seen is None else seen
        for name, given in {"targets": targets, "seen": seen}.items():
            if len(given) != len(tasks):
                raise ShapeError(f"{name} must hold one entry for each of {len(tasks)} tasks, got {len(given)}")
        return [task(T[..., i, :, :], J_b[..., i, :, :], targets[i], seen[i]) for i, task in enumerate(tasks)]

    def forward(
        self,
        rates: Sequence[TaskRate],
        descent: Tensor | None = None,
        bounds: RateBounds | None = None,
        rounds: int = 4,
    ) -> Tensor:
        """The velocity qdot (..., n), rad/s and m/s.

        Args:
            rates: What the tasks ask for, from `rates`.
            descent: (..., n) velocity to follow where no task forbids it, the negative gradient of a cost; None for 0.
            bounds, rounds: See `solved_within`; None for no bounds.
        """

        def solve(fixed: Tensor | None, free: Tensor | None) -> Tensor:
            if fixed is None or free is None:
                return self._solved(rates, descent, bounds)
            left = [_without(rate, fixed, free) for rate in rates]
            return self._solved(left, None if descent is None else descent * free, bounds)

        return solve(None, None) if bounds is None else solved_within(solve, bounds, rounds)

    def _solved(self, rates: Sequence[TaskRate], descent: Tensor | None, bounds: RateBounds | None) -> Tensor:
        damping = aligned(self.damping, 2)
        spread = None if self.coordinate_weights is None else self.coordinate_weights.rsqrt()
        qdot: Tensor | None = None
        N: Tensor | None = None
        J_free: Tensor | None = None
        for level in self.levels:
            if J_free is not None:
                N = _left_free(J_free, N, damping)
            J, v = weighted_rows([rates[i] for i in level])
            if spread is not None:
                J = J * spread.to(J).unsqueeze(-2)
            J_free = J if N is None else J @ N
            left = v if qdot is None else v - J @ qdot
            J_pinv = damped_pseudo_inverse(J_free, eased(damping, left, bounds))
            qdot = J_pinv @ left + (0.0 if qdot is None else qdot)
        assert qdot is not None and J_free is not None  # there is at least one task
        spread = None if spread is None else spread.to(qdot)
        if descent is not None:
            down = (descent if spread is None else descent / spread).unsqueeze(-1)
            qdot = qdot + (down if N is None else N @ down) - J_pinv @ (J_free @ down)
        qdot = qdot.squeeze(-1)
        return qdot if spread is None else spread * qdot


def _left_free(J: Tensor, N: Tensor | None, damping: Setting) -> Tensor:
    """The projector (..., n, n) onto what N leaves free and J (..., m, n) does not move by more than the damping."""
    n = J.shape[-1]
    # One row that is not finite would stop the decomposition of all; that row's velocity is lost anyway.
    finite = torch.isfinite(J).all(-1).all(-1)[..., None, None]
    _, strength, moved = torch.linalg.svd(torch.where(finite, J, 0.0), full_matrices=False)
    rounding = n * torch.finfo(J.dtype).eps * strength[..., :1]
    least = damping.squeeze(-1) if isinstance(damping, Tensor) else damping
    taken = moved * (strength > least + rounding).to(J).unsqueeze(-1)
    before = torch.eye(n, dtype=J.dtype, device=J.device) if N is None else N
    return before - taken.mT @ taken


def _without(rate: TaskRate, fixed: Tensor, free: Tensor) -> TaskRate:
    """What the task asks of the free coordinates, the others moving at their fixed rates."""
    velocity = rate.velocity - (rate.J @ fixed.unsqueeze(-1)).squeeze(-1)
    return TaskRate(rate.J * free.unsqueeze(-2), velocity, rate.error, rate.weight)
