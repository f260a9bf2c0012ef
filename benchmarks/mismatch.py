"""What decides the actuation mismatch of experiment II: `python benchmarks/mismatch.py`, a few minutes.

The set-point of section VI-B on the simulated arm with the platform's independent tendons, by the model of the coupled
ones: Eq. (53), averaged until the tip is within a millimetre as the paper does, and Psi, of the standard controller and
of Eq. (15), with one open choice changed at a time. Runs that differ in numbers alone are rows of one batch.
"""

from __future__ import annotations

import argparse

import torch
from run_settings import run_settings

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.stacking import stacked
from apcc_torch.experiments.dynamic import Outcome, one_of, simulate
from apcc_torch.simulation.metrics import mapping_error

ARRIVED = 1e-3
"""m, where the paper ends a run."""
STANDARD = 1e-9
"""A Gamma with which no length moves: the standard controller as one more row."""
BASE = (
    "experiment=setpoint", "experiment.duration=8.0", "adaptation=slow", "adaptation.gain_scale=1.0",
    "arm.layout=coupled", "plant.arm.layout=independent", "plant.pid.K_P=2.0e+4", "sensors=mocap",
    "bounds.lower=0.3", "bounds.upper=2.0",
)  # fmt: skip
GAMMAS = (STANDARD, 0.5, 0.6, 40.0)
PRINTED, POSITIONS = "adaptation.regressor=partial", "feedback.mode=position"

CASES: dict[str, tuple[str, ...]] = {
    "as printed, positions": (PRINTED, POSITIONS),
    "as printed, poses": (PRINTED,),
    "total derivative": ("bounds.lower=0.75", "bounds.upper=1.25"),
    "tendons 7.5 kN/m": (PRINTED, "plant.pid.K_P=7.5e+3"),
    "tendons 50 kN/m": (PRINTED, "plant.pid.K_P=5.0e+4"),
    "tendons only pull": (PRINTED, "plant.transmission.slack=true"),
    "1 m per rad": (PRINTED, "feedback.angular_weight=1.0"),
    "window of 45": (PRINTED, "velocity_filter.window=45"),
    "payload 0.21 kg": (PRINTED, "experiment.payloads=[0.21]"),
    "the right layout": (PRINTED, "arm.layout=independent"),
}
"""What is changed -> its settings."""


def measured(outcome: Outcome) -> tuple[float, float, float]:
    """Seconds to arrival, mean of Eq. (53) and mean of Psi until then, cm."""
    log, arms = outcome
    near = ((log.x_d - log.x).norm(dim=-1)[:, 0] < ARRIVED).nonzero()
    end = int(near[0]) + 1 if len(near) else len(log.time)
    mismatch = mapping_error(arms.model, log.q_d, log.pi_hat, log.x)[:end, 0].mean()
    psi = log.q_bar[:end, 0, arms.model.coordinates.elongations].norm(dim=-1).mean()
    return float(log.time[end - 1]), 1e2 * float(mismatch), 1e2 * float(psi)


def run(configs: list[SimulateSettings]) -> list[tuple[float, float, float]]:
    """What each run of one batch reached."""
    together = simulate(stacked(configs), points=len(configs))
    return [measured(one_of(together, config, p)) for p, config in enumerate(configs)]


def main() -> None:
    """Prints a line a case: the standard controller, and Eq. (15) for each Gamma."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=list(CASES), help="cases; default: all")
    parser.add_argument("--compile", default="off", help="aot is faster where many are run (default: %(default)s)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'mismatch cm / Psi cm, until arrival':<40}" + "".join(f"{f'Gamma {g:g}':>16}" for g in GAMMAS[1:]))
    for case in options.only:
        settings = (*BASE, *CASES[case], f"compile={options.compile}")
        values = run([run_settings(*settings, f"adaptation.gamma={gamma}") for gamma in GAMMAS])
        time, mismatch, psi = values[0]
        line = f"{case:<24}{mismatch:.2f} / {psi:.2f} in {time:.1f} s".ljust(40)
        for _, other, elongation in values[1:]:
            line += f"{f'{100 * (other / mismatch - 1):+.0f} % / {100 * (elongation / psi - 1):+.0f} %':>16}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
