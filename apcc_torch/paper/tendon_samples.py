"""Experiment I as the paper draws it: tendon differentials and estimates of the rest lengths, uniform, run by run.

The paper samples U(-0.035, 0) m for the tendons of the first rack and U(-0.075, 0) m for the others, and pi_hat = pi +
epsilon with "epsilon ~ U(-0.3, 0.3)". A section is 0.1 to 0.25 m long, so 0.3 m cannot be meant. Nor can 30 %: the
sections of 0.25 m in table I would then be off by up to 74 mm, and the largest of all its differences is 26 mm.
U(-0.03, 0.03) m fits every one of them, and is what is drawn here.
"""

from __future__ import annotations

import torch

from apcc_torch.model.arm import Arm

FIRST_RACK, OTHERS = 0.035, 0.075
"""How far a tendon is pulled in at most, m."""
EPSILON = 0.03
"""How far an estimate is off at most, m."""


def sampled_runs(arm: Arm, count: int, seed: int) -> dict[str, list[str]]:
    """Runs of experiment I: name -> what differs in that run, as `series.runs` has it.

    Args:
        arm: Its tendons by rack, and the rest lengths pi.
        count: How many runs.
        seed: Of the draws; a run's numbers do not depend on how many follow it.

    Example:
        >>> list(sampled_runs(Arm(lengths=[0.1, 0.2, 0.3]), 2, seed=0))
        ['run_1', 'run_2']
    """
    generator = torch.Generator().manual_seed(seed)
    pi = arm.rest_lengths()
    reach = torch.full((arm.n_tendons,), OTHERS, dtype=torch.float64)
    reach[: arm.tendons_per_rack] = FIRST_RACK
    runs = {}
    for k in range(count):
        pulled, off = (torch.rand(n, generator=generator, dtype=torch.float64) for n in (len(reach), len(pi)))
        estimate = pi + EPSILON * (2.0 * off - 1.0)
        runs[f"run_{k + 1}"] = [f"ramp.goal={_list(-reach * pulled)}", f"ramp.estimate={_list(estimate)}"]
    return runs


def _list(values: torch.Tensor) -> str:
    return f"[{', '.join(f'{value:.4f}' for value in values.tolist())}]"
