"""What noisy orientations leave of run II's angular residual: `python benchmarks/noise_limit.py`, two minutes.

The named set-point with the largest payload, under `dynamic_run_2_bank_noisy`, in two tables:

1. Algorithm 2 once more, at instants of that motion, with the true poses and a share of the sensors' noise: a filter
   that is never late. For the rest lengths that the controller had, and for those of a wide grid that happen to be the
   best at each instant with that very noise.
2. The closed loop with the pose filter's time constant from short to long: what the filter lets through, and how late.
"""

from __future__ import annotations

import argparse

import torch
from run_settings import run_settings
from torch import Tensor
from tqdm import tqdm

from apcc_torch.composition.build import Builder
from apcc_torch.composition.stacking import stacked
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.experiments.dynamic import curves, one_of, simulate, thinned
from apcc_torch.model.abscissae import decouple
from apcc_torch.paper.best_lengths import INSTANTS, length_grid, patient_feedback
from apcc_torch.paper.outcomes import single_row
from apcc_torch.simulation.metrics import orientation_error
from apcc_torch.simulation.sensors import PoseSensors

SHARES = (1.0, 0.5, 0.3, 0.2, 0.1)
TIMES = (0.01, 0.03, 0.05, 0.1, 0.2, 0.5)


def residuals(feedback: StateFeedback, q: Tensor, lengths: list[Tensor], seen: Tensor, T: Tensor) -> Tensor:
    """(G, ...) mean angles (crad) from the model that sees `seen` to the true poses T, for each of G rest lengths."""
    found = []
    for pi in lengths:
        q_bar = feedback(q, pi.expand(*q.shape[:-1], pi.shape[-1]), seen).q_bar
        error = orientation_error(feedback.backbone, q_bar, pi, feedback.abscissae, T[..., :3, :3])
        found.append(1e2 * error.mean(-1))
    return torch.stack(found)


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compile", default="aot", help="off where there is no g++ (default: %(default)s)")
    noisy = ("experiment=dynamic_run_2_bank_noisy", f"compile={parser.parse_args().compile}")
    torch.set_num_threads(1)
    shipped = run_settings(*noisy)
    row = single_row(shipped.experiment.payloads)
    own = shipped.pose_filter.angular_time
    times = sorted({*TIMES, own})
    configs = [run_settings(*noisy, f"pose_filter.angular_time={time}") for time in times]
    every = simulate(stacked(configs), points=len(configs))
    runs = [one_of(every, config, p) for p, config in enumerate(configs)]

    log, arms = runs[times.index(own)]
    few, build = thinned(log, INSTANTS), Builder(shipped)
    q, pi_hat = few.q_bar[:, row], few.pi_hat[:, row]
    feedback, lengths = patient_feedback(build), [pi_hat, *length_grid(shipped, build)]
    s, rows = shipped.sensors, []
    with torch.inference_mode():
        T = arms.true.pose(few.q_true[:, row], arms.true_lengths, *decouple(arms.sensors, arms.true_lengths))
        for share in tqdm(SHARES, desc="shares of the noise"):
            sensors = PoseSensors(share * s.position_noise, share * s.angular_noise)
            _, seen, _ = sensors(sensors.initial_state(T), T, torch.Generator().manual_seed(0))
            left = residuals(feedback, q, lengths, seen, T)
            rows.append(f"{share:>18.0%} {float(left[0].mean()):>22.2f} {float(left.amin(0).mean()):>26.2f}")
    print("share of the noise   its own rest lengths   the best at each instant   (crad)", *rows, sep="\n")
    print("\ntime constant (s)    angular residual (crad)   tip after 10 s (mm)   Psi (cm)")
    for time, run in zip(times, runs, strict=True):
        c = curves(thinned(run.log), run.arms)
        angular, tip, psi = 1e2 * c.angular[:, row].mean(), 1e3 * c.e[-1].mean(), 1e2 * c.psi.mean()
        print(f"{time:>17g} {float(angular):>26.2f} {float(tip):>21.2f} {float(psi):>10.2f}")


if __name__ == "__main__":
    main()
