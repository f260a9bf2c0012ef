"""What mixed sensor sets tell of an arm's shape: `python benchmarks/mixed_sensors.py`, three minutes.

Cosserat rods hang at rest under random tensions and a load that nobody tells, as another solver finds them: they twist
and shear, and have eight elements a section where the estimator has two pieces. Sensors and tendons are read with the
noise that the estimator is told; headings of inertial units begin anywhere within 0.3 rad and drift. After a second and
a half the estimated shape is held against the rod's, point by point.

With --loop the law runs on `plant=rod` instead, with the same noise, over payloads, set-points and seeds.
"""

from __future__ import annotations

import argparse
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from apcc_torch import Arm, compose
from apcc_torch.estimation.counted import counted
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.experiments.dynamic import metrics, simulate
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.curvature import curvature_places, curvature_weights, middle_curvature
from apcc_torch.model.statics import equilibrium
from apcc_torch.simulation.curvature_sensors import CurvatureSensorsSettings
from apcc_torch.simulation.inertial_units import InertialUnitsSettings
from apcc_torch.simulation.rod_plant import RodPlant, RodPlantSettings
from apcc_torch.simulation.sensors import PoseSensors

D = torch.float64
PERIOD = 0.02
PULL = 2.0
"""Largest tension of a tendon, N."""
ELEMENTS = 8
"""Of a rod, in each section."""
ARM = Arm(lengths=[0.105, 0.255, 0.24])
UNITS = (0.12, 0.36, 0.6)
GRATINGS = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55)
INERTIAL_NOISE = {"tilt_noise": "tilt_noise", "heading": "heading_noise", "heading_drift": "heading_drift"}
"""Settings of inertial units as they are, and as the estimator has them."""
SETS = {
    "pose at the tip": ARM.changed(sensors=(0.6,)),
    "pose at the tip, two inertial units": ARM.changed(sensors=UNITS, sensed=("orientation", "orientation", "pose")),
    "pose at the tip, two tilts": ARM.changed(sensors=UNITS, sensed=("tilt", "tilt", "pose")),
    "pose at the tip, curvature at six places": ARM.changed(sensors=(0.6,), curvature_sensors=GRATINGS),
    "pose in the middle": ARM.changed(sensors=(0.36,)),
    "pose in the middle, two inertial units": ARM.changed(sensors=UNITS, sensed=("orientation", "pose", "orientation")),
    "three inertial units": ARM.changed(sensors=UNITS, sensed=("orientation",) * 3),
    "three inertial units, curvature at six places": ARM.changed(
        sensors=UNITS, sensed=("orientation",) * 3, curvature_sensors=GRATINGS
    ),
    "position of the tip, curvature at six places": ARM.changed(
        sensors=(0.6,), sensed=("position",), curvature_sensors=GRATINGS
    ),
    "three poses": ARM.changed(sensors=UNITS),
}


class Resting(NamedTuple):
    """Arms at rest: their dynamics, configurations (R, n), and loads (R,) kg."""

    dynamics: ArmDynamics
    q: Tensor
    load: Tensor


class Found(NamedTuple):
    """Of each row (R,): mean distance of the shape, and that of the tip, m. nees: mean of the strains'; band: half of a
    95 % one."""

    shape: Tensor
    tip: Tensor
    nees: float
    band: float


def rods(arm: Arm, settings: LoadedShapeSettings, rows: int, seed: int = 1) -> Resting:
    """Cosserat rods under random tensions and loads."""
    return resting(arm, RodPlant.dynamics_of(arm, RodPlantSettings(refine=ELEMENTS)), settings, rows, seed)


def resting(arm: Arm, dynamics: ArmDynamics, settings: LoadedShapeSettings, rows: int, seed: int = 1) -> Resting:
    """Equilibria of an arm under random tensions and the loads that the estimator expects."""
    draw = torch.Generator().manual_seed(seed)
    load = float(settings.load) * float(dynamics.masses.sum()) * torch.randn(rows, generator=draw, dtype=D).abs()
    pulls = PULL * torch.rand(rows, arm.n_tendons, generator=draw, dtype=D)
    solved = equilibrium(dynamics, routing=arm.routing(), tensions=pulls, payload=load)
    return Resting(dynamics, solved.q[solved.converged], load[solved.converged])


def readings(arm: Arm, settings: LoadedShapeSettings) -> PoseSensors:
    """The arm's sensors, as noisy as the estimator believes."""
    s = settings
    return PoseSensors(
        position_noise=s.position_noise,
        angular_noise=s.angular_noise,
        tendon_noise=s.tendon_noise,
        inertial=InertialUnitsSettings(**{name: getattr(s, of) for name, of in INERTIAL_NOISE.items()}),
        curvature=CurvatureSensorsSettings(noise=s.curvature_noise),
        kinds=arm.sensor_kinds(),
        period=PERIOD,
    )


def estimated(arm: Arm, true: Resting, settings: LoadedShapeSettings, steps: int = 75, seed: int = 2) -> Found:
    """What an arm's sensors make of arms at rest.

    Args:
        arm: With its sensors.
        true: As many pieces a section as its dynamics has.
        settings: Of the estimator, and of the noise.
        steps: Of the estimator.
        seed: Of the noise.
    """
    dynamics, q = true.dynamics, true.q
    model, lengths, rows = dynamics.kinematics(), dynamics.lengths, len(true.q)
    T = model.pose(q, lengths, *decouple(arm.sensor_places(), lengths))
    y, pieces = q @ model.tendon_matrix(arm.routing(), lengths), len(lengths) // arm.n_sections
    places, bent = curvature_places(arm), None
    if places is not None:
        bent = curvature_weights(lengths, pieces, places) @ middle_curvature(model, q, lengths)
    generator, sensors = torch.Generator().manual_seed(seed), readings(arm, settings)
    memory, shape, rest = sensors.initial_state(T, bent, generator), LoadedShape.on(arm, settings), arm.rest_lengths()
    none = torch.zeros_like(rest)
    state = shape.initial_state(torch.stack((none, none, rest), dim=-1).flatten().expand(rows, -1))
    dt, P = torch.full((rows,), PERIOD, dtype=D), torch.empty(0)
    for _ in range(steps):
        draws = sensors.draw(T, generator, y.shape[-1], 0 if places is None else len(places))
        memory, seen = sensors.sense(memory, T, bent, draws)
        usable, oriented = counted(seen.T, arm.sensor_kinds(), seen.mask)
        arguments = (state, seen.T, usable, oriented, sensors.measured_tendons(y, None, draws), dt, seen.curvature)
        P, state = shape.covariance(*arguments), shape(*arguments)
    points, own = torch.linspace(0.02, 1.0, 50, dtype=D) * rest.sum(), shape.dynamics.lengths
    found = shape.backbone.pose(shape.configuration(state), own, *decouple(points, own))[..., :3, 3]
    off = (found - model.pose(q, lengths, *decouple(points, lengths))[..., :3, 3]).norm(dim=-1)
    # A section's strain is the sum of its pieces', of which a rod has more than bends and an elongation.
    every = q.unflatten(-1, (len(lengths), -1))[..., [0, 1, -1]].unflatten(-2, (-1, pieces)).sum(-2).flatten(-2)
    wrong = shape.strain(state) - every
    n = wrong.shape[-1]
    weighed = (wrong * torch.linalg.solve(P[:, :n, :n], wrong.unsqueeze(-1)).squeeze(-1)).mean()
    return Found(off.mean(-1), off[:, -1], float(weighed), 1.96 * sqrt(2.0 / (rows * n)))


def in_the_loop(arm: Arm, seed: int) -> dict[str, float]:
    """Metrics of 6 s under the law on a rod, over payloads and set-points."""
    s = LoadedShapeSettings()
    noise = {"position_noise": s.position_noise, "angular_noise": s.angular_noise, "tendon_noise": s.tendon_noise}
    kinds = arm.sensor_kinds()
    if kinds is not None and kinds.inertial:
        noise |= {f"inertial.{name}": getattr(s, of) for name, of in INERTIAL_NOISE.items()}
    if arm.curvature_sensors is not None:
        noise["curvature.noise"] = s.curvature_noise
    words = [f"sensors.{name}={value}" for name, value in noise.items()]
    words += [f"arm.{name}={_text(getattr(arm, name))}" for name in ("sensors", "sensed", "curvature_sensors")]
    run = ("experiment=dynamic_run_2", "plant=rod", "experiment.duration=6", f"seed={seed}", "progress=false")
    return metrics(simulate(compose(*run, *words).settings))


def _text(value: object) -> str:
    return "null" if value is None else str(list(value)).replace("'", "").replace(" ", "")  # type: ignore[call-overload]


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", action="store_true", help="in closed loop")
    parser.add_argument("--seeds", type=int, default=3, help="of the noise, in closed loop")
    parser.add_argument("--only", default="", help="sets with this in their names")
    parser.add_argument("--rows", type=int, default=300, help="arms at rest")
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings, lines = LoadedShapeSettings(), ["| sensors | shape, mm | worst tenth | tip, mm | NEES |"]
    lines.append("|---|---|---|---|---|")
    if args.loop:
        lines = ["| sensors | shape error of the law's last 5 s, mm | largest |", "|---|---|---|"]
    true = None if args.loop else rods(ARM, settings, args.rows)
    for name, arm in tqdm(SETS.items(), desc="sets"):
        if args.only and args.only not in name:
            continue
        if true is None:
            told = [in_the_loop(arm, seed) for seed in range(args.seeds)]
            mean = sum(each["shape_error_last5s_mean_mm"] for each in told) / len(told)
            most = max(each["shape_error_last5s_max_mm"] for each in told)
            lines.append(f"| {name} | {mean:.2f} | {most:.2f} |")
            continue
        found = estimated(arm, true, settings)
        worst = 1e3 * float(found.shape.quantile(0.9))
        lines.append(
            f"| {name} | {1e3 * float(found.shape.mean()):.2f} | {worst:.2f} | {1e3 * float(found.tip.mean()):.2f} "
            f"| {found.nees:.2f} |"
        )
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
