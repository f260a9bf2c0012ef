"""The rule behind the set-points in conf/experiment: `python benchmarks/setpoints.py` prints both lists.

20000 configurations of the three-section model without elongation, each section's bend drawn evenly from a disc of
0.8 rad, give tips spread as the arm can reach them; tips above 0.15 arm lengths below the base are dropped. Lloyd's
algorithm puts ten centres among them, one held at the paper's named point; the other nine, moved to the nearest drawn
tip and rounded to 5 mm, are the set-points, in order of distance from the named one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.backbone import HANGING, PCCBackbone

ARMS = {
    "arm_1": ((0.105, 0.255, 0.24), (0.325, 0.15, -0.275)),
    "arm_2": ((0.15, 0.15, 0.15), (0.15, 0.225, -0.1875)),
}


def setpoints(lengths: tuple[float, ...], named: tuple[float, ...], count: int = 10, seed: int = 0) -> Tensor:
    """(count, 3) set-points, m; the first is the named one."""
    generator = torch.Generator().manual_seed(seed)
    L0 = torch.tensor(lengths, dtype=torch.float64)
    draws = torch.rand(20000, len(lengths), 2, generator=generator, dtype=torch.float64)
    radius, angle = 0.8 * draws[..., 0].sqrt(), 2.0 * torch.pi * draws[..., 1]
    q = torch.stack((radius * angle.cos(), radius * angle.sin(), torch.zeros_like(radius)), dim=-1).flatten(-2)
    tips = PCCBackbone(len(lengths), torch.tensor(HANGING, dtype=torch.float64)).tip(q, L0)
    tips = tips[tips[:, 2] < -0.15 * L0.sum()]
    first = torch.tensor(named, dtype=torch.float64)
    centres = torch.cat((first[None], tips[: count - 1]))
    for _ in range(100):
        nearest = torch.cdist(tips, centres).argmin(1)
        moved = torch.stack([tips[nearest == k].mean(0) for k in range(1, count)])
        centres = torch.cat((first[None], moved))
    chosen = tips[torch.cdist(centres[1:], tips).argmin(1)]
    chosen = chosen[(chosen - first).norm(dim=-1).argsort()]
    return torch.cat((first[None], torch.round(chosen / 0.005) * 0.005))


if __name__ == "__main__":
    for name, (lengths, named) in ARMS.items():
        print(name)
        for point in setpoints(lengths, named).tolist():
            print(f"  - [{', '.join(f'{v:.4g}' for v in point)}]")
