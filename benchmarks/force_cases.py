"""The arms, postures and estimators that `benchmarks/forces.py` compares."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from run_settings import GENTLE, run_settings
from torch import Tensor

from apcc_torch import StateFeedback
from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.estimation.external_force import BalanceNoise, ForceBalance
from apcc_torch.estimation.load_from_shape import LoadFromShape
from apcc_torch.estimation.posture import Posture
from apcc_torch.experiments.dynamic import simulate
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.equation_of_motion import EquationOfMotion
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.loads import Loads
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.part import hold_rows
from apcc_torch.settings import Setting
from apcc_torch.simulation.dynamic import DynamicLog

D = torch.float64
READINGS = 20
"""Readings that an estimate takes the mean of, over the last half second of a run."""
NOISE = BalanceNoise()
MEAN_NOISE = BalanceNoise(*(value / READINGS**0.5 for value in NOISE[:3]), *NOISE[3:])
ENCODER_NOISE = 1e-4
"""Of a tendon's length change, m, the same in all readings."""
CONTROLLERS = {
    "fixed": ("experiment=dynamic_run_2_tuned", "controller.adaptive=false", *GENTLE),
}  # fmt: skip
ABSCISSAE = {1: 0.105, 2: 0.2325, 3: 0.36, 4: 0.48, 5: 0.6}
"""Tips of the true arm's sections, m: where it is touched."""


FORCES = (1.0, 2.0)  # N
SECTIONS = tuple(ABSCISSAE)
TARES = ("none", "posture")
Results = dict[str, dict[str, dict[str, float]]]


def case(section: int, size: float, how: str) -> str:
    """Name of one kind of contact."""
    return f"{ABSCISSAE[section]:g} m, {size:g} N, tare {how}"


def settings(*overrides: str) -> SimulateSettings:
    """The settings of a run of section V-B under noisy sensors."""
    return run_settings("sensors=mocap", *overrides)


class Seen(NamedTuple):
    """Rows R as their sensors tell, at rest or nearly.

    q_bar (R, 9), pi_hat (R, 3), qdot (R, 9): of the controller's model. T: (K, R, k, 4, 4) readings. y, u: (R, 9)
    tendons, less the drag of their guides. payload: (R,) kg, the truth.
    """

    q_bar: Tensor
    pi_hat: Tensor
    qdot: Tensor
    T: Tensor
    y: Tensor
    u: Tensor
    payload: Tensor


class TouchedArm(SoftArmDynamics):
    """An arm with forces that stay on it.

    Args:
        arm: Its parameters.
        touch: (..., n_b, 6) torque and force at every section's tip, world axes.
    """

    touch: Tensor

    def __init__(self, arm: SoftArmDynamics, touch: Tensor) -> None:
        stiffness = arm.stiffness_diagonal
        axial, bending, damping = stiffness[..., 2::3], stiffness[..., ::3], arm.damping_diagonal
        super().__init__(arm.lengths, arm.masses, axial, bending, damping=damping, base_rotation=arm.base_rotation)
        hold_rows(self, touch=(touch, 2))

    def equation(self, q: Tensor, qdot: Tensor, payload: Any = None, *loads: Tensor | None) -> EquationOfMotion:
        """See `SoftArmDynamics.equation`; the forces that stay are its only loads."""
        return super().equation(q, qdot, payload, section_wrenches=self.touch)


def true_poses(build: Builder, q: Tensor) -> Tensor:
    """Poses (..., k, 4, 4) of the sensors on the true arm."""
    plant = build.plant(torch.zeros((), dtype=D))
    lengths = plant.dynamics.lengths
    return plant.backbone.pose(q, lengths, *decouple(build.sensors_at(), lengths))


def read(build: Builder, T: Tensor, generator: torch.Generator) -> Tensor:
    """Noisy readings of poses."""
    sensors = build.pose_sensors()
    return sensors(sensors.initial_state(T), T, generator)[1]


def arrived(controller: str, compile: str, generator: torch.Generator) -> Seen:
    """The last half second of the thirty runs of section V-B."""
    config = settings(f"compile={compile}", *CONTROLLERS[controller])
    log: DynamicLog = simulate(config).log
    build = Builder(config)
    last, half = slice(-50, None), 25
    q = log.q_bar[last]
    qdot = (q[half:].mean(0) - q[:half].mean(0)) / (0.01 * half)
    speed = (log.y[-1] - log.y[-50]) / 0.49
    u = log.u[last].mean(0) - config.plant.tendon_damping * speed
    places = torch.linspace(-50, -1, READINGS).round().long()
    T = read(build, true_poses(build, log.q_true[places]), generator)
    return Seen(
        q.mean(0), log.pi_hat[last].mean(0), qdot, T, _noisy(log.y[-1], ENCODER_NOISE, generator),
        _noisy(u, MEAN_NOISE.tension, generator), build.grid()[1],
    )  # fmt: skip


def held(build: Builder, y: Tensor, q: Tensor, touch: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Readings (1, R, k, 4, 4) and tendon forces (R, 9) of arms at rest with tendons held at y, touched."""
    plant = build.plant(torch.zeros((), dtype=D))
    rest = equilibrium(
        plant.dynamics, routing=build.routing(), tendon_lengths=y, loads=Loads(section_wrenches=touch), q=q,
        tolerance=1e-9,
    )  # fmt: skip
    if rest.u is None or not bool(rest.converged.all()):
        raise RuntimeError("an arm that was touched found no rest")
    T = read(build, true_poses(build, rest.q).expand(READINGS, *y.shape[:-1], 3, 4, 4), generator)
    return T, _noisy(rest.u, MEAN_NOISE.tension, generator)


def _noisy(value: Tensor, noise: Setting, generator: torch.Generator) -> Tensor:
    return value + noise * torch.randn(value.shape, dtype=value.dtype, generator=generator)


def balance(build: Builder, model: KinematicModel, stiffer: float = 1.0) -> ForceBalance:
    """The balance of forces on a model that knows the arm's material, or takes it for stiffer, not its six sections."""
    p = build.config.arm
    rigidity = (stiffer * p.stiffness_reference * k for k in (p.axial_stiffness, p.bending_stiffness))
    body = StaticBody(model, p.mass / 0.6, *rigidity)
    feedback = StateFeedback(model, build.sensors_at(), angular_weight=0.03, max_iterations=40)
    return ForceBalance(body, build.routing(), feedback, MEAN_NOISE, damping_ratio=p.damping_ratio)


def affine(build: Builder) -> AffineBackbone:
    """Three sections whose curvature varies."""
    return AffineBackbone(3, build.base_rotation())


def posture(b: ForceBalance, T: Tensor, u: Tensor | None, pi: Tensor) -> Posture:
    """The mean posture that a model infers from readings (K, R, k, 4, 4), its rest lengths fixed."""
    zero = torch.zeros(b.body.backbone.n, dtype=D)
    q = zero.expand(*T.shape[1:-3], zero.shape[-1])
    for _ in range(2):  # from the straight arm to the shape, then on
        q = b.feedback(q, pi, T).q_bar.mean(0)
    return Posture(q, pi.expand(*q.shape[:-1], 3), u)


def finer(build: Builder, own: bool = False) -> LoadFromShape:
    """Nine sections, three between neighbouring racks, under tendons of known length; or the true arm's own six."""
    p = build.config.arm
    if own:
        lengths = build.true_lengths()
    else:
        ends = torch.cat((torch.zeros(1, dtype=D), build.sensors_at()))
        lengths = (ends.diff() / 3.0).repeat_interleave(3)
    axial, bending = scaled_stiffness(lengths, p.stiffness_reference, p.axial_stiffness, p.bending_stiffness)
    arm = SoftArmDynamics(lengths, p.mass / 0.6 * lengths, axial, bending, base_rotation=build.base_rotation())
    return LoadFromShape(arm, build.routing(), build.sensors_at())
