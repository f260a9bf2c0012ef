"""apcc/Reach-v0 under controllers that look ahead or do not: `python examples/reach_ahead.py`, two minutes.

The dynamic arm carries 0.5 kg that no controller is told of, and the first estimates of its lengths are wrong by up to
15 %. All controllers get the same episodes. Words are those of `python -m apcc_torch.simulate`, of the look ahead:
`python examples/reach_ahead.py lookahead.samples=256 lookahead.horizon=0.4`. Most of the time goes into machine code,
which is built once. `--quick` takes fewer arms, less time and no machine code.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

import apcc_torch.envs
from apcc_torch.composed import compose
from apcc_torch.report.dynamic import settling_times
from apcc_torch.settings import Settings

gymnasium.register_envs(apcc_torch.envs)

RATE, NEAR = 50, 0.01
FEW = ("lookahead.samples=64",)
"""A quarter of the ways that ship: arms are many here, and they get most of what there is to gain."""


class Score(NamedTuple):
    """How the rows of a controller arrived.

    settled: (N,) s until the tip stays within 10 mm, infinite where it does not. end: (N,) m. step: s that a step took.
    """

    settled: np.ndarray
    end: np.ndarray
    step: float

    def __str__(self) -> str:
        """A line of the table."""
        arrived = self.settled[np.isfinite(self.settled)]
        when = (
            f"{np.median(arrived):5.2f} s, slowest {arrived.max():5.2f} s" if len(arrived) else "   - s, slowest    - s"
        )
        told = f"{len(arrived):4} of {len(self.settled)} within 10 mm after {when}"
        return f"{told}, at the end {1e3 * self.end.mean():5.1f} mm, {1e3 * self.step:6.2f} ms a step"


def controllers(lookahead: Settings | None) -> dict[str, dict[str, Any]]:
    """What differs on the controller of the environment, by name."""
    fixed = {"adaptive": False}
    return {
        "standard": fixed,
        "law": {},
        "look ahead, lengths fixed": {**fixed, "lookahead": lookahead},
        "look ahead, law": {"lookahead": lookahead},
    }


def scored(control: dict[str, Any], rows: int, seed: int, mode: str, seconds: int) -> Score:
    """Whole episodes, with the law's gains as they ship."""
    steps = RATE * seconds
    settings = {"dynamics": "dynamic", "action": "adaptation", "payload": (0.5, 0.5), "control_rate": RATE}
    length = {"max_episode_steps": steps + 1, "plant": {"substeps": 2}}
    envs = gymnasium.make_vec("apcc/Reach-v0", rows, control=control, compile=mode, **settings, **length)
    _, info = envs.reset(seed=seed)
    errors, still = [info["error"]], torch.zeros(envs.action_space.shape)
    began = time.perf_counter()
    for _ in range(steps):
        errors.append(envs.step(still)[4]["error"])
    took = (time.perf_counter() - began) / steps
    e = torch.stack(errors).numpy()
    return Score(settling_times(np.arange(len(e)) / RATE, e, NEAR), e[-1], took)


def main(words: Sequence[str] | None = None) -> None:
    """Prints a line a controller."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="of simulate, such as lookahead.samples=256")
    parser.add_argument("--rows", type=int, default=32, help="arms side by side (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: %(default)s)")
    parser.add_argument("--compile", default="auto", help="how steps are run (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="2 arms, eagerly, with fewer and shorter rollouts")
    given = parser.parse_args(words)
    few, seconds = FEW, 6
    if given.quick:
        given.rows, given.compile, seconds, few = 2, "off", 3, ("lookahead.samples=16", "lookahead.steps=8")
    composed = compose("experiment=dynamic_run_2", "lookahead=mppi", *few, *given.words)
    for name, control in controllers(composed.settings.lookahead).items():
        print(f"{name:<26}{scored(control, given.rows, given.seed, given.compile, seconds)}", flush=True)


if __name__ == "__main__":
    main()
