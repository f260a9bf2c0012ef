"""Settings to objects: the one place where the parts of a run are joined."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.composition.run_settings import RunSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm, vector
from apcc_torch.model.curvature import curvature_places
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import part_of
from apcc_torch.simulation.divergence import Divergence
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.spread import Numbers, spread

DTYPES = {"float64": torch.float64, "float32": torch.float32}

SUBSETS = {"all": slice(None), "training": slice(0, None, 2), "held_out": slice(1, None, 2)}
"""Set-points by their index: tuning may look at those with even index only."""


class Builder:
    """Builds the objects of one run, or of several runs side by side, all of one dtype and device.

    Args:
        config: The settings; of several runs, from `stacking.stacked`.
        points: How many runs; None for one without a dimension of its own. With P, leading shapes are (P, rows).

    Raises:
        ConfigError: There is no such device.
    """

    def __init__(self, config: RunSettings, points: int | None = None) -> None:
        self.config = config
        self.points = points
        self.dtype = DTYPES[config.dtype]
        self.device = torch.device(getattr(config, "device", "cpu"))
        if self.device.type != "cpu":
            try:
                torch.ones(1, device=self.device).item()
            # Torch says so with another error for each kind of device that it was not built for.
            except (RuntimeError, NotImplementedError, AssertionError) as error:
                raise ConfigError(f"device is {str(self.device)!r}, but torch has no such device here") from error

    def placed(self, made: Any) -> Any:
        """A tensor or module with the run's dtype and on its device."""
        return made.to(dtype=self.dtype, device=self.device)

    @property
    def arm(self) -> Arm:
        """The arm as it is believed to be."""
        return self.config.arm

    @property
    def true_arm(self) -> Arm:
        """The arm of the plant."""
        return self.config.plant.true_arm(self.arm)

    @property
    def n_sections(self) -> int:
        """Sections of the model."""
        return self.arm.n_sections

    def vector(self, key: str, values: Numbers, size: int) -> Tensor:
        """Numbers as a tensor (size,); one list a run is (P, 1, size) already.

        Raises:
            ConfigError: They are not so many numbers.
        """
        return self.placed(spread(key, values, size))

    def rest_lengths(self) -> Tensor:
        """(n_b,) nominal rest lengths of the model, m: the true ones in the kinematic simulation."""
        return self.placed(self.arm.rest_lengths())

    def true_lengths(self) -> Tensor:
        """(n_t,) rest lengths of the plant's sections, m."""
        return self.placed(self.true_arm.refined(self.config.plant.refine))

    def first_estimate(self) -> Tensor:
        """(n_b,) pi_hat at the start, m; of several runs (P, 1, n_b)."""
        share = self.vector("experiment.first_estimate", self.config.experiment.first_estimate, self.n_sections)
        estimate = share * self.rest_lengths()
        return estimate if self.points is None else estimate.expand(self.points, 1, self.n_sections)

    def base_rotation(self) -> Tensor:
        """(3, 3) base of the arm in the world."""
        return self.placed(self.arm.base_rotation())

    def backbone(self) -> KinematicModel:
        """The kinematic model."""
        model = self.config.model
        return self.placed(part_of(model).on(self.n_sections, self.arm.base_rotation(), model))

    def sensors_at(self) -> Tensor:
        """(k,) abscissae where the sensors are believed to be, m."""
        return self.placed(self.arm.sensor_places())

    def true_sensors_at(self) -> Tensor:
        """(k,) abscissae where the plant's sensors are, m."""
        return self.placed(self.true_arm.true_sensor_places())

    def routing(self) -> TendonRouting:
        """Tendons of the model."""
        return self.placed(self.arm.routing())

    def controller(self, adaptive: bool | None = None) -> APCCController:
        """The controller; `adaptive` overrides the setting."""
        config = self.config
        if adaptive is not None:
            config = config.changed(controller=config.controller.changed(adaptive=adaptive))
        kind = APCCController if config.lookahead is None else LookaheadController
        return self.placed(kind.on(self.arm, config, self.first_estimate()))

    def sine(self) -> SineTrajectory:
        """Eq. (51)'s trajectory."""
        e = self.config.experiment
        if e.r_0 is None or e.A is None:
            raise ConfigError("experiment.r_0 and experiment.A must be given for a sine trajectory")
        return SineTrajectory(self.vector("experiment.r_0", e.r_0, 3), self.vector("experiment.A", e.A, 3), e.omega)

    def setpoints(self) -> Tensor:
        """(S, 3) set-points of the chosen subset, m; of several runs with their own (P, S, 3)."""
        points, subset = self.config.experiment.setpoints, self.config.experiment.subset
        if isinstance(points, Tensor):
            return points[:, SUBSETS[subset]]
        if not points:
            raise ConfigError("experiment.setpoints must list at least one point [x, y, z]")
        chosen = list(enumerate(points))[SUBSETS[subset]]
        if not chosen:
            raise ConfigError(f"experiment.subset={subset} leaves none of {len(points)} set-points")
        return torch.stack([self.vector(f"experiment.setpoints[{i}]", point, 3) for i, point in chosen])

    def payloads(self) -> Tensor:
        """(L,) payloads, kg; of several runs (P, L)."""
        payloads = self.placed(vector(self.config.experiment.payloads))
        if payloads.dim() > 1:
            payloads = payloads.squeeze(-2)
        return payloads if self.points is None else payloads.expand(self.points, -1)

    def grid(self) -> tuple[SetPoint, Tensor]:
        """Every set-point with every payload: (S L, 3) targets, payload fastest, and (S L,) payloads."""
        points, payloads = self.setpoints(), self.payloads()
        rows = points.repeat_interleave(payloads.shape[-1], dim=-2)
        return SetPoint(rows), payloads.repeat(*[1] * (payloads.dim() - 1), points.shape[-2])

    def plant(self, payload: Tensor) -> Plant:
        """The true arm with its tendons and their PID loop, one row a payload."""
        plant = self.config.plant
        return self.placed(part_of(plant).on(self.arm, payload, plant))

    def divergence(self) -> Divergence:
        """What says which rows diverged."""
        return Divergence(self.config.divergence)

    def pose_sensors(self) -> PoseSensors:
        """What stands between the true poses and the controller."""
        # Runs side by side have one seed, and each sees what it would see alone.
        return PoseSensors(
            self.config.sensors,
            shared=0 if self.points is None else 1,
            kinds=self.arm.sensor_kinds(),
            period=1.0 / float(self.config.controller.rate),
        )

    def curvature_places(self) -> Tensor | None:
        """(n_c,) abscissae where curvature is measured, m; None for nowhere."""
        places = curvature_places(self.arm)
        return None if places is None else self.placed(places)
