"""What the dynamics of an arm say of a state: its equation of motion and its energies."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class EquationOfMotion(NamedTuple):
    """M qddot + bias = tau - K q - D qdot.

    inertia: (..., n, n) M(q).
    bias: (..., n) C(q, qdot) qdot + G(q) less the generalized external loads.
    """

    inertia: Tensor
    bias: Tensor


class Energy(NamedTuple):
    """Energies in J, each (...). potential = gravity + elastic."""

    kinetic: Tensor
    potential: Tensor
    gravity: Tensor
    elastic: Tensor
