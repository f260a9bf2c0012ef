"""What `python -m apcc_torch.export` can be set to, and the library that it means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import with_dynamics
from apcc_torch.composition.run_settings import (
    ON_AN_ARM,
    ExperimentSettings,
    ForcedRunSettings,
    SimulateSettings,
)
from apcc_torch.composition.unread import Unread, of_a_run
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.estimate_covariance import SensorNoise
from apcc_torch.control.lookahead_refusal import LookaheadRefusal
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.shape_law import ShapeLaw
from apcc_torch.errors import ConfigError
from apcc_torch.exporting.functions import Controller, Function, control_functions, kinematic, loop_function
from apcc_torch.exporting.plant_functions import plant_functions
from apcc_torch.exporting.settings import PRECISIONS, LibrarySettings
from apcc_torch.part import part_of
from apcc_torch.settings import names


@dataclass(frozen=True, kw_only=True)
class ExportSettings(LibrarySettings, ForcedRunSettings):
    """Root of `python -m apcc_torch.export`."""

    elsewhere: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(ON_AN_ARM, "python -m apcc_torch.robot"),
        **dict.fromkeys(
            (name for name in names(SimulateSettings) if name not in names(ForcedRunSettings)),
            "python -m apcc_torch.simulate",
        ),
    }


def of_an_export(c: ExportSettings) -> Unread:
    """What a library does not depend on."""
    yield from of_a_run(c, velocity=c.dynamics_law is not None)
    alone = "the controller alone is exported"
    read = ("first_estimate", *(("payloads",) if c.with_plant else ()))
    unread = [f"experiment.{each.name}" for each in fields(ExperimentSettings) if each.name not in ("name", *read)]
    yield " ".join(unread), f"{alone}, its target comes with each step"
    yield "sensors divergence seed compile", alone
    yield "dtype", "precision says it"
    if not c.with_plant:
        yield "controller.rate", "elapsed time is told by the stamps of the measurements"
        held = [f"plant.{name}" for name in names(type(c.plant)) if name != "pid" or c.actuation != "forces"]
        yield " ".join(held), "with_plant is false"
    if not c.covariance:
        yield "position_noise angular_noise", "covariance is false"
    elif c.controller.adaptive and c.adaptation is not None and issubclass(part_of(c.adaptation), ShapeLaw):
        yield "position_noise angular_noise", "the law of the shape has its own"


class Parts(NamedTuple):
    """What a library is made of.

    controller: With a routing. pi_hat: (n_b,) first estimates, m. sensors: (k,) where they are, m. functions: All.
    dt: s, a step of the plant; None without one.
    """

    controller: Controller
    pi_hat: Tensor
    sensors: Tensor
    functions: list[Function]
    dt: float | None


def parts(settings: ExportSettings) -> Parts:
    """The parts of a library.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    real = PRECISIONS[settings.precision]
    LookaheadRefusal.LIBRARY.check(settings.lookahead is not None)
    build = Builder(settings.changed(dtype="float64" if real == torch.float64 else "float32"))
    controller: Any = with_dynamics(build, build.controller())
    pi_hat, sensors = build.first_estimate(), build.sensors_at()
    noise = SensorNoise(settings.position_noise, settings.angular_noise) if settings.covariance else None
    made = control_functions(controller, pi_hat, noise)
    forced, dt = isinstance(controller, CompositeController), None
    if settings.actuation == "forces":
        if kinematic(controller).pressure is not None:
            raise ConfigError("actuation=forces is a loop on tendons, and arm has chambers: leave it at lengths")
        routing = kinematic(controller).routing
        assert routing is not None  # of every arm
        made.append(loop_function(TendonPID(settings.plant.pid), routing.n_tendons, forced, pi_hat))
    if settings.with_plant:
        payloads = build.payloads()
        if payloads.shape != (1,):
            raise ConfigError(f"experiment.payloads must hold one payload for the plant, got {payloads.tolist()}")
        dt = 1.0 / (settings.controller.rate * settings.plant.substeps)
        made += plant_functions(build.plant(payloads[0]), dt, build.true_sensors_at(), forced)
    return Parts(controller, pi_hat, sensors, made, dt)
