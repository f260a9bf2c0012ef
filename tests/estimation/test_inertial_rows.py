"""Tilt and heading of one rotation against another, by swing and twist."""

from __future__ import annotations

import torch

from apcc_torch.estimation.inertial_rows import heading, tilt
from apcc_torch.lie import so3
from laws import generator, normal, uniform

D = torch.float64


def test_any_rotation_is_a_heading_after_a_tilt() -> None:
    """R_m = exp(psi z) R exp(t), with t across the vertical, put together again."""
    draw = generator(1)
    R, measured = (so3.exp(normal((200, 3), D, draw)) for _ in range(2))
    t, psi = tilt(R[:, 2], measured[:, 2]), heading(R, measured)
    torch.testing.assert_close((t * R[:, 2]).sum(-1), torch.zeros(200, dtype=D), rtol=0, atol=1e-12)
    # The tilt alone brings the vertical to where it was measured.
    turned = R @ so3.exp(t)
    torch.testing.assert_close(turned[:, 2], measured[:, 2], rtol=0, atol=1e-12)
    # The swing-twist of R_m R^T: what the twist leaves has none.
    z = torch.stack((0.0 * psi, 0.0 * psi, psi), dim=-1)
    left = so3.exp(-z) @ measured @ R.mT
    torch.testing.assert_close(left[:, 1, 0], left[:, 0, 1], rtol=0, atol=1e-12)


def test_a_heading_changes_no_tilt_and_adds_to_the_heading() -> None:
    draw = generator(2)
    R = so3.exp(normal((100, 3), D, draw))
    measured = R @ so3.exp(0.3 * normal((100, 3), D, draw))
    psi = uniform((100,), -1.0, 1.0, D, draw)
    turned = so3.exp(torch.stack((0.0 * psi, 0.0 * psi, psi), dim=-1)) @ measured
    torch.testing.assert_close(tilt(R[:, 2], turned[:, 2]), tilt(R[:, 2], measured[:, 2]), rtol=0, atol=1e-12)
    torch.testing.assert_close(heading(R, turned), heading(R, measured) + psi, rtol=0, atol=1e-12)


def test_from_head_to_foot_and_at_rest_it_is_finite_with_its_gradient() -> None:
    R = so3.exp(torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.2, 0.1]], dtype=D)).requires_grad_()
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=D)) @ R.detach()
    for measured in (R.detach(), over):
        found = tilt(R[:, 2], measured[:, 2]).sum() + heading(R, measured).sum()
        (gradient,) = torch.autograd.grad(found, R)
        assert bool(torch.isfinite(found)) and bool(torch.isfinite(gradient).all())
