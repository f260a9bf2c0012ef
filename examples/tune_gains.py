"""Tunes section V-A by gradients: `python examples/tune_gains.py` (minutes), with `--quick` in seconds.

K, Gamma, the null-space gain, the normalisation and the weights of the velocity filter's window are tuned at once, by
gradients through the whole closed loop. The regressor's velocity is the measured one and the sensors are noisy, so that
the window matters.

The cost of a run is the root mean square of the tip's error plus that of the distances between the model's backbone and
the true one, in mm, over time and the runs. It is tuned on the first seconds from some first estimates of the rest
lengths, and tried on the whole time from others, with other noise.
"""

from __future__ import annotations

import argparse
from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch import APCCController, InverseKinematics, PCCBackbone, StateFeedback
from apcc_torch.control.adaptation import NormalisedLaw
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.step_io import ControllerState, Measurement
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.estimation.soft_window import SoftWindow
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import HANGING
from apcc_torch.simulation.kinematic import start_configuration
from apcc_torch.simulation.rollout import rollout
from apcc_torch.simulation.sensors import Draws, PoseSensors

D = torch.float64
TRUE = torch.tensor([0.105, 0.255, 0.240], dtype=D)
GUESS = torch.tensor([0.120, 0.280, 0.270], dtype=D)
SENSORS = torch.tensor([0.105, 0.36, 0.60], dtype=D)
PATH = SineTrajectory(torch.tensor([0.0, 0.0, -0.5], dtype=D), torch.tensor([0.5, 0.3, 0.1], dtype=D), 0.2 * pi)
BACKBONE = PCCBackbone(3, torch.tensor(HANGING, dtype=D))
RATE = 50.0
WINDOW = 15


class Gains(NamedTuple):
    """What is tuned: K (), Gamma (3,), null gain () m/s, normalisation () s^2, window (15,), newest sample last."""

    K: Tensor
    gamma: Tensor
    null_gain: Tensor
    normalisation: Tensor
    window: Tensor


# The settings of conf/experiment/kinematic.yaml, tuned by hand, and a window whose samples count alike.
BY_HAND = Gains(
    torch.tensor(1.0, dtype=D),
    torch.tensor([90.0, 42.5, 35.0], dtype=D),
    torch.tensor(1.0, dtype=D),
    torch.tensor(10.0, dtype=D),
    torch.ones(WINDOW, dtype=D),
)


def controller(gains: Gains) -> APCCController:
    """The controller of section V-A, its gains with their graph."""
    return APCCController(
        BACKBONE,
        StateFeedback(BACKBONE, SENSORS),
        SoftWindow(gains.window, order=2),
        InverseKinematics(gains.K, null_gain=gains.null_gain),
        NormalisedLaw(3, gains.gamma, normalisation=gains.normalisation),
        bounds=LengthBounds(TRUE, SENSORS, lower=0.6, upper=1.4, reach="last"),
    )


def cost(gains: Gains, starts: Tensor, duration: float, seed: int) -> Tensor:
    """Tip and backbone errors (2,), mm, of runs from first estimates (R, 3)."""
    follower = controller(gains)
    sensors = PoseSensors(position_noise=2e-4, angular_noise=9e-3)  # as conf/sensors/mocap.yaml
    X_tilde, j = decouple(SENSORS, TRUE)
    generator = torch.Generator().manual_seed(seed)
    share = torch.linspace(0.0, 1.0, 20, dtype=D)

    class State(NamedTuple):
        q: Tensor
        controller: ControllerState

    def period(now: State, time: Tensor, draws: Draws) -> tuple[State, tuple[Tensor, Tensor]]:
        T = BACKBONE.pose(now.q, TRUE, X_tilde, j)
        seen = sensors.sense(sensors.initial_state(T), T, None, draws)[1]
        later, command = follower(now.controller, Measurement(seen.T, time, seen.mask), PATH(time))
        tip = PATH(time).x_d - BACKBONE.tip(now.q, TRUE)
        gap = BACKBONE.points(now.q, TRUE, len(share)) - BACKBONE.points(later.q_bar, now.controller.pi_hat, len(share))
        return State(now.q + command.qdot / RATE, later), (tip.square().sum(-1), gap.square().sum(-1).mean(-1))

    q = start_configuration(BACKBONE, TRUE, PATH(torch.zeros((), dtype=D)).x_d).expand(len(starts), 9)
    first = State(q, follower.initial_state(q, starts))
    T = BACKBONE.pose(q, TRUE, X_tilde, j)
    _, squares = rollout(
        period,
        first,
        lambda k: (torch.tensor(k / RATE, dtype=D), sensors.draw(T, generator)),
        round(duration * RATE),
        checkpointed=True,
    )
    return 1e3 * torch.stack([square.mean().sqrt() for square in squares])


def tune(starts: Tensor, duration: float, iterations: int, seed: int) -> Gains:
    """The gains of the lowest cost that Adam met on its way, in the logarithms of all gains."""
    logs = [value.log().requires_grad_() for value in BY_HAND]
    optimizer = torch.optim.Adam(logs, lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    best, lowest = BY_HAND, float("inf")
    for k in range(iterations):
        gains = Gains(*(log.exp() for log in logs))
        parts = cost(gains, starts, duration, seed)
        total = parts.sum()
        tip, backbone = parts.tolist()
        if tip + backbone < lowest:
            best, lowest = Gains(*(value.detach() for value in gains)), tip + backbone
        optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(logs, 10.0)
        print(f"{k:3d}  tip {tip:.3f} mm  backbone {backbone:.3f} mm  cost {tip + backbone:.3f}", flush=True)
        optimizer.step()
        schedule.step()
    return best


def guesses(count: int, seed: int) -> Tensor:
    """First estimates (count, 3) up to 15 % off, m."""
    draws = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=D)
    return TRUE * (1.0 + 0.15 * (2.0 * draws - 1.0))


def main(arguments: list[str] | None = None) -> dict[str, tuple[float, float]]:
    """Tunes and prints; returns the cost before and after, in training and held out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few periods and steps, to see it run")
    quick = parser.parse_args(arguments).quick
    torch.set_num_threads(1)
    starts = torch.cat((GUESS.unsqueeze(0), guesses(1 if quick else 3, 0)))
    duration, iterations, whole = (0.4, 3, 0.4) if quick else (3.0, 30, 20.0)
    tuned = tune(starts, duration, iterations, seed=0)
    trials = {"tuned on": (starts, duration, 0), "held out": (guesses(2 if quick else 8, 1), whole, 1)}
    found = {}
    with torch.no_grad():
        for name, trial in trials.items():
            before, after = (cost(gains, *trial) for gains in (BY_HAND, tuned))
            found[name] = (float(before.sum()), float(after.sum()))
            parts = "  ".join(
                f"{what} {float(a):.3f} -> {float(b):.3f} mm"
                for what, a, b in zip(("tip", "backbone"), before, after, strict=True)
            )
            print(f"{name}: cost {found[name][0]:.3f} -> {found[name][1]:.3f}  ({parts})")
            even = float(cost(tuned._replace(window=BY_HAND.window), *trial).sum())
            print(f"{name}: cost {even:.3f} with the tuned gains and the window by hand")
    for name, value in tuned._asdict().items():
        shown = value / value.max() if name == "window" else value
        print(f"{name}: {[round(v, 3) for v in shown.reshape(-1).tolist()]}")
    return found


if __name__ == "__main__":
    main()
