"""What noisy orientations leave of run II's angular residual: `python benchmarks/noise_limit.py`, two minutes.

The named set-point with the largest payload, under `dynamic_run_2_bank_noisy`, in two tables:

1. Algorithm 2 once more, at instants of that motion, with the true poses and a share of the sensors' noise: a filter
   that is never late. For the rest lengths that the controller had, and for those of a wide grid that happen to be the
   best at each instant with that very noise.
2. The closed loop with the pose filter's time constant from short to long: what the filter lets through, and how late.
"""

from __future__ import annotations

import torch
from run_settings import run_settings
from torch import Tensor

from apcc_torch.configs.batch import stacked
from apcc_torch.configs.build import Builder
from apcc_torch.experiments.dynamic import curves, one_of, simulate, thinned
from apcc_torch.experiments.paper_limits import INSTANTS, length_grid
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.simulation.metrics import orientation_error

NOISY = ("experiment=dynamic_run_2_bank_noisy", "compile=aot")
SHARES = (1.0, 0.5, 0.3, 0.2, 0.1)
TIMES = (0.01, 0.03, 0.05, 0.1, 0.2, 0.5)


def single(c: RunCurves, payloads: int) -> float:
    """Mean angular residual, crad, at the named set-point with the largest payload."""
    return 1e2 * float(c.angular[:, payloads - 1].mean())


def left(share: float, q: Tensor, pi_hat: Tensor, T: Tensor) -> tuple[float, float]:
    """Mean angular residual (crad) with a share of the noise: of pi_hat, and the least that rest lengths leave."""
    config = run_settings(*NOISY)
    build = Builder(config)
    feedback = build.controller(adaptive=False).feedback
    feedback.max_iterations = 25
    spread = share * torch.tensor([config.sensors.angular_noise] * 3 + [config.sensors.position_noise] * 3)
    noise = spread.to(T) * torch.randn(*T.shape[:-2], 6, dtype=T.dtype, generator=torch.Generator().manual_seed(0))
    seen = T @ se3.exp(noise)
    found = []
    for pi in (pi_hat, *length_grid(config, build)):
        pi = pi.expand_as(pi_hat)
        q_bar = feedback(q, pi, seen).q_bar
        error = orientation_error(feedback.backbone, q_bar, pi, feedback.abscissae, T[..., :3, :3])
        found.append(1e2 * error.mean(-1))
    return float(found[0].mean()), float(torch.stack(found).amin(0).mean())


def main() -> None:
    """Prints both tables."""
    torch.set_num_threads(1)
    configs = [run_settings(*NOISY, f"pose_filter.angular_time={time}") for time in TIMES]
    payloads = len(configs[0].experiment.payloads)
    every = simulate(stacked(configs), points=len(configs))
    runs = [one_of(every, config, p) for p, config in enumerate(configs)]

    shipped = runs[TIMES.index(run_settings(*NOISY).pose_filter.angular_time)]
    few, arms, row = thinned(shipped.log, INSTANTS), shipped.arms, payloads - 1
    q_true, q, pi_hat = few.q_true[:, row], few.q_bar[:, row], few.pi_hat[:, row]
    with torch.inference_mode():
        T = arms.true.pose(q_true, arms.true_lengths, *decouple(arms.sensors, arms.true_lengths))
        print("share of the noise   its own rest lengths   the best at each instant   (crad)")
        for share in SHARES:
            print("{:>18.0%} {:>22.2f} {:>26.2f}".format(share, *left(share, q, pi_hat, T)))
    print("\ntime constant (s)    angular residual (crad)   tip after 10 s (mm)   Psi (cm)")
    for time, run in zip(TIMES, runs, strict=True):
        c = curves(thinned(run.log), run.arms)
        tip, psi = 1e3 * float(c.e[-1].mean()), 1e2 * float(c.psi.mean())
        print(f"{time:>17g} {single(c, payloads):>26.2f} {tip:>21.2f} {psi:>10.2f}")


if __name__ == "__main__":
    main()
