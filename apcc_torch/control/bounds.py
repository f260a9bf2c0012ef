"""Bounds on vectors entry by entry, and velocities within bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor

from apcc_torch.model.coordinates import Coordinates
from apcc_torch.modes import none_left
from apcc_torch.settings import Setting, aligned
from apcc_torch.shapes import check_tensor

Solve = Callable[[Tensor | None, Tensor | None], Tensor]
"""Of fixed rates and of what is free to a velocity; see `solved_within`."""


class RateBounds(NamedTuple):
    """Bounds on qdot.

    lower, upper: (..., n) of each rate, rad/s and m/s, infinite where there is none.
    together: (...) or a number, of what a task asks of all rates together, see `eased`; None for none.
    """

    lower: Tensor
    upper: Tensor
    together: Setting | None = None


class ReferenceBounds:
    """Bounds of q_d: what is beyond its bound already, as a start may be, is not pushed farther out.

    Args:
        coordinates: What q_d is made of.
        bend, elongation: Its bounds, rad and m, numbers or (...); None for none.
    """

    def __init__(self, coordinates: Coordinates, bend: Setting | None, elongation: Setting | None) -> None:
        self.coordinates = coordinates
        self.bend, self.elongation = (torch.inf if bound is None else bound for bound in (bend, elongation))

    @classmethod
    def of(cls, coordinates: Coordinates, bend: Setting | None, elongation: Setting | None) -> Self | None:
        """The bounds; None where there is none."""
        return None if bend is None and elongation is None else cls(coordinates, bend, elongation)

    def _of(self, q_d: Tensor) -> Tensor:
        return self.coordinates.per_unit(self.bend, self.elongation, q_d.shape[-1], q_d)

    def rates(self, q_d: Tensor, dt: Tensor) -> RateBounds:
        """Bounds on qdot that keep q_d (..., n) within its own for dt (...)."""
        bound, step = self._of(q_d), dt.unsqueeze(-1).clamp(min=1e-6)
        return RateBounds(((-bound - q_d) / step).clamp(max=0.0), ((bound - q_d) / step).clamp(min=0.0))

    def held(self, q_d: Tensor) -> Tensor:
        """q_d (..., n) within its bounds."""
        bound = self._of(q_d)
        return torch.minimum(torch.maximum(q_d, -bound), bound)


def solved_within(solve: Solve, bounds: RateBounds, rounds: int = 4) -> Tensor:
    """A velocity qdot (..., n) within bounds, by an active set: a coordinate that would leave them drops out.

    Args:
        solve: The velocity (..., n) of the coordinates that are free, (..., n) ones and zeros, the others moving at
            rates (..., n); of both None, that of all coordinates.
        bounds: Bounds on qdot. A coordinate that would leave them is held at its bound and the others make up for it as
            far as they can; what leaves them after the last round is cut. A row within them stays as it is, to the bit.
        rounds: Most rounds of that.
    """
    first = solved = solve(None, None)
    lower, upper = (check_tensor(name, getattr(bounds, name), solved.shape[-1:]) for name in ("lower", "upper"))
    held = torch.zeros_like(solved, dtype=torch.bool)
    fixed = torch.zeros_like(solved)
    for _ in range(rounds):
        out = (solved < lower) | (solved > upper)
        if none_left(out):
            break
        fixed = torch.where(out & ~held, torch.minimum(torch.maximum(solved, lower), upper), fixed)
        held = held | out
        free = (~held).to(solved)
        solved = solve(fixed, free) * free + fixed
    return torch.where(held.any(-1, keepdim=True), torch.minimum(torch.maximum(solved, lower), upper), first)


def eased(damping: float | Tensor, velocity: Tensor, bounds: RateBounds | None) -> float | Tensor:
    """The damping of a pseudo-inverse that keeps |qdot| within `bounds.together` for a task velocity (..., m, 1).

    The damped pseudo-inverse makes at most |v| / (2 damping) of v, whatever the Jacobian. Rates that are cut one by one
    near a singular shape lead elsewhere; so a direction of the task that hardly any rate moves is given up first, and
    the others are followed. As the task comes to rest the damping becomes its own again. Error-damped pseudo-inverse:
    Chan, Lawrence: General inverse kinematics with the error damped pseudoinverse, ICRA 1988.

    Args:
        damping: Its own, (..., 1, 1) or a number: the least.
        velocity: (..., m, 1) asked of the task.
        bounds: Of qdot; None for none.
    """
    if bounds is None or bounds.together is None:
        return damping
    needed = torch.linalg.vector_norm(velocity, dim=(-2, -1), keepdim=True) / (2.0 * aligned(bounds.together, 2))
    return torch.maximum(needed, torch.as_tensor(damping, dtype=needed.dtype, device=needed.device))


def within(x: Tensor, bound: Setting | None) -> Tensor:
    """x (..., n), every entry held to a magnitude of at most `bound`, a number or (...); None for no bound."""
    if bound is None:
        return x
    if isinstance(bound, Tensor):
        limit = aligned(bound, 1)
        return torch.minimum(torch.maximum(x, -limit), limit)
    return x.clamp(-bound, bound)
