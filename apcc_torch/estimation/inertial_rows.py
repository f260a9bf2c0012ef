"""What inertial units tell of an arm's shape: which way is up, firmly, and a heading that drifts.

A unit's tilt comes from gravity, its heading from a gyroscope alone: R_m = exp(psi z) R exp(delta), z upward, delta
small, psi drifting from an offset that nobody tells. Swing and twist keep the two apart: u = R^T z does not depend on
psi, and the twist of R_m R^T about z is psi + u delta. So the tilt counts with its own noise, and the heading with
that of delta and psi together. That is psi marginalised: the least squares over the shape and psi have the same
minimum. psi is not remembered from sample to sample. What would say it is the shape, and the shape leans on the same
priors and the same model at every sample; a psi that is carried along would count those anew each time, and be believed
more than it is known.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.settings import Setting, aligned


def tilt(up: Tensor, measured: Tensor) -> Tensor:
    """The least turn (..., 3) rad, in the body's axes, after which `up` is where it was measured.

    Args:
        up: (..., 3) the world's z axis in the body's axes, of length 1.
        measured: (..., 3) the same as it is measured.

    Example:
        >>> straight, bent = torch.eye(3)[2], so3.exp(torch.tensor([0.0, 0.3, 0.0])).mT @ torch.eye(3)[2]
        >>> tilt(straight, bent)
        tensor([-0.0000, 0.3000, 0.0000])
    """
    axis = torch.linalg.cross(measured, up)
    square = axis.square().sum(-1, keepdim=True)
    flat = square < torch.finfo(up.dtype).eps ** 2
    sine = torch.where(flat, 1.0, square).sqrt()
    angle = torch.atan2(sine, (up * measured).sum(-1, keepdim=True))
    return axis * torch.where(flat, 1.0, angle / sine)


def heading(R: Tensor, measured: Tensor) -> Tensor:
    """Turn (...) rad about the world's z axis from rotations R to measured ones, (..., 3, 3); 0 from head to foot.

    Example:
        >>> R, z = so3.exp(torch.tensor([0.5, -0.3, 0.2])), torch.tensor([0.0, 0.0, 0.7])
        >>> heading(R, so3.exp(z) @ R)
        tensor(0.7000)
    """
    turn = measured @ R.mT
    sine, cosine = turn[..., 1, 0] - turn[..., 0, 1], turn[..., 0, 0] + turn[..., 1, 1]
    known = sine.square() + cosine.square() > torch.finfo(R.dtype).eps
    return torch.atan2(torch.where(known, sine, 0.0), torch.where(known, cosine, 1.0))


def inertial_rows(
    R: Tensor, measured: Tensor, counts: Tensor, headed: Tensor, tilt_noise: Setting, heading_variance: Tensor
) -> tuple[Tensor, Tensor]:
    """What p units leave of a shape, over its standard deviation, and the weight of a turn of the body in it.

    Args:
        R: (..., p, 3, 3) of the shape.
        measured: (..., p, 3, 3) of the units, finite.
        counts: (..., p) bool.
        headed: (p,) 1.0 for units that tell a heading, else 0.
        tilt_noise: rad.
        heading_variance: (...) rad^2, of headings beside that.

    Returns:
        r (..., p, 3), and W (..., p, 3, 3): a small turn (..., 3) of the body's own axes lowers r by W times it.
    """
    noise = aligned(tilt_noise, 1)
    firm = counts.to(R) / noise
    loose = counts.to(R) * headed / (heading_variance.unsqueeze(-1) + noise**2).sqrt()
    up = R[..., 2, :]
    r = tilt(up, measured[..., 2, :]) * firm.unsqueeze(-1) + up * (heading(R, measured) * loose).unsqueeze(-1)
    along = up.unsqueeze(-1) * up.unsqueeze(-2)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return r, eye * firm[..., None, None] + along * (loose - firm)[..., None, None]
