"""Kinematics and algorithm 2 as machine code, one line each: what torch computes, and what autograd says of it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.func import jacfwd, jvp, vmap

from apcc_torch import PCCBackbone, StateFeedback, decouple
from apcc_torch.native import NativeFunction
from apcc_torch.native.structure import flattened
from laws import generator, normal

D = torch.float64
L0 = torch.tensor([0.2, 0.25], dtype=D)


def configurations(rows: int, sections: int) -> tuple[Tensor, Tensor]:
    """q and qdot, some of them nearly straight, where the formulas are series."""
    q, qdot = (0.5 * normal((rows, 3 * sections), D, generator(seed)) for seed in (1, 2))
    q[:, 2::3] *= 0.05
    q[0], q[1] = 0.0, 1e-9 * q[1]
    return q, qdot


def close(have: Any, want: Any) -> None:
    for a, b in zip(flattened(have), flattened(want), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_tip_and_jacobian() -> None:
    backbone, (q, _) = PCCBackbone(2), configurations(13, 2)
    fast = NativeFunction(backbone.tip_and_jacobian, (q[0], L0))
    tip, J = fast(q, L0)
    close((tip, J), backbone.tip_and_jacobian(q, L0))
    close(J, vmap(jacfwd(lambda each: backbone.tip(each, L0)))(q))
    # Lengths may differ from row to row, without another library.
    lengths = L0 * torch.linspace(0.8, 1.2, 13, dtype=D).unsqueeze(-1)
    close(fast(q, lengths), backbone.tip_and_jacobian(q, lengths))
    # Another method of the same module is another program.
    close(NativeFunction(backbone.tip, (q[0], L0))(q, L0), tip)


def test_regressor() -> None:
    """Theorem 1: the tip's velocity is linear in the rest lengths, with the columns of Y."""
    backbone, (q, qdot) = PCCBackbone(2), configurations(13, 2)
    Y, Phi = NativeFunction(backbone.regressor, (q[0], qdot[0]))(q, qdot)
    close((Y, Phi), backbone.regressor(q, qdot))
    _, xdot = vmap(lambda q, qdot: jvp(lambda each: backbone.tip(each, L0), (q,), (qdot,)))(q, qdot)
    close(Y @ L0 + Phi, xdot)


def test_algorithm_2_alone() -> None:
    length, backbone = L0[:1], PCCBackbone(1)
    q, qdot = configurations(13, 1)
    estimation: nn.Module = StateFeedback(backbone, length, min_iterations=5, max_iterations=5)
    T, seed = backbone.pose(q, length, *decouple(length, length)), q + 0.05 * qdot
    found = NativeFunction(estimation, (seed[0], length, T[0]))(seed, length, T)
    close(found, estimation(seed, length, T))
    torch.testing.assert_close(found.q_bar, q, rtol=0, atol=1e-9)  # the poses are the model's own
