"""Section stiffness scaled from a reference section."""

from __future__ import annotations

from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.settings import Setting
from apcc_torch.shapes import check_positive, check_tensor


def scaled_stiffness(
    lengths: Tensor, reference: Setting = 0.1, axial: Setting = 100.0, bending: Setting = 0.778, rule: str = "series"
) -> tuple[Tensor, Tensor]:
    """Axial and bending stiffness of sections from those of one section of `reference` length.

    Beam theory gives EA/l and EI/l, springs in series: a longer section is softer ("series"). The paper scales the
    stiffness matrices "according to their respective lengths", which read literally makes a longer section stiffer
    ("proportional"). The choice is the caller's.

    Args:
        lengths: (..., n_b) section rest lengths, m.
        reference: Length of the reference section, m; this and the next two a number, or (..., 1) one a row.
        axial: Its axial stiffness, N/m.
        bending: Its bending stiffness, N m/rad.
        rule: "series" or "proportional".

    Returns:
        Axial stiffness (..., n_b) N/m and bending stiffness (..., n_b) N m/rad.

    Raises:
        ValueRangeError: A length is not positive, or `rule` is unknown.

    Example:
        >>> scaled_stiffness(torch.tensor([0.1, 0.2]), reference=0.1, axial=100.0, bending=0.8)
        (tensor([100.,  50.]), tensor([0.8000, 0.4000]))
    """
    check_positive("lengths", check_tensor("lengths", lengths, (None,)))
    if rule == "series":
        scale = reference / lengths
    elif rule == "proportional":
        scale = lengths / reference
    else:
        raise ValueRangeError(f"rule must be 'series' or 'proportional', got {rule!r}")
    return axial * scale, bending * scale
