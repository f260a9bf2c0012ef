"""Settings to objects. Every refusal is one sentence that names the key."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import torch
from torch import Tensor

from apcc_torch.composition.choice import choice
from apcc_torch.composition.kinematic_model import kinematic_model
from apcc_torch.composition.residual_law import residual_law
from apcc_torch.composition.schema import PlantConfig, RobotConfig, SimulateConfig
from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.friction import TendonTransmission
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.settings import Setting, aligned, is_used
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors

DTYPES = {"float64": torch.float64, "float32": torch.float32}
BASES = {"hanging": HANGING, "standing": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}

SUBSETS = {"all": slice(None), "training": slice(0, None, 2), "held_out": slice(1, None, 2)}
"""Set-points by their index: tuning may look at those with even index only."""


class Builder:
    """Builds the objects of one run, or of several runs side by side, all of one dtype and device.

    Args:
        config: The resolved settings; of several runs, from `configs.batch.stacked`.
        points: How many runs; None for one without a dimension of its own. With P, leading shapes are (P, rows).

    Raises:
        ConfigError: dtype, device or another setting has no meaning.
    """

    def __init__(self, config: SimulateConfig, points: int | None = None) -> None:
        self.config = config
        self.points = points
        self.dtype = DTYPES[choice("dtype", config.dtype, tuple(DTYPES))]
        if config.device.startswith("cuda") and not torch.cuda.is_available():
            raise ConfigError(f"device is {config.device!r}, but torch finds no CUDA device")
        self.device = torch.device(config.device)

    def vector(self, key: str, values: Sequence[float] | Tensor, size: int | None = None) -> Tensor:
        """A list of numbers as a tensor (size,); one list a run is (P, 1, size) already.

        Raises:
            ConfigError: The list has another length, or is not a list of numbers.
        """
        if isinstance(values, Tensor):
            tensor = values
        else:
            try:
                tensor = torch.tensor([float(v) for v in values], dtype=self.dtype, device=self.device)
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{key} must be a list of numbers, got {values!r}") from error
        if size is not None and tensor.shape[-1] != size:
            raise ConfigError(f"{key} must have {size} entries, got {tensor.shape[-1]}")
        return tensor

    def gain(self, key: str, value: object, size: int, scale: Setting = 1.0) -> Tensor:
        """A number or a list of `size` numbers, scaled: 0-d or (size,); of several runs (P, 1, size, size)."""
        one = value[:, :, None].expand(-1, -1, size) if isinstance(value, Tensor) and value.dim() == 2 else value
        diagonal = self._diagonal(key, one, size)
        if diagonal.dim() < 2 and not isinstance(scale, Tensor):
            return diagonal * scale
        return torch.diag_embed(diagonal.expand(*diagonal.shape[:-1], size) * aligned(scale, 1))

    def _diagonal(self, key: str, value: object, size: int) -> Tensor:
        if isinstance(value, Tensor):
            return self.vector(key, value, size)
        if isinstance(value, bool | str):
            raise ConfigError(f"{key} must be a number or a list of {size} numbers, got {value!r}")
        if isinstance(value, int | float):
            return torch.tensor(float(value), dtype=self.dtype, device=self.device)
        if not isinstance(value, Sequence):
            raise ConfigError(f"{key} must be a number or a list of {size} numbers, got {value!r}")
        return self.vector(key, value, size)

    @property
    def n_sections(self) -> int:
        """Sections of the model."""
        lengths = self.config.robot.rest_lengths
        return int(lengths.shape[-1]) if isinstance(lengths, Tensor) else len(lengths)

    def rest_lengths(self) -> Tensor:
        """(n_b,) nominal rest lengths of the model, m: the true ones in the kinematic simulation."""
        lengths = self.vector("robot.rest_lengths", self.config.robot.rest_lengths)
        if not bool((lengths > 0).all()):
            raise ConfigError(f"robot.rest_lengths must be positive, got {self.config.robot.rest_lengths}")
        return lengths

    def first_estimate(self) -> Tensor:
        """(n_b,) pi_hat at the start, m; of several runs (P, 1, n_b)."""
        values = self.config.robot.initial_estimate
        estimate = self.rest_lengths()
        if values is not None:
            estimate = self.vector("robot.initial_estimate", values, self.n_sections)
        if not bool((estimate > 0).all()):
            raise ConfigError(f"robot.initial_estimate must be positive, got {values}")
        return estimate if self.points is None else estimate.expand(self.points, 1, self.n_sections)

    def base_rotation(self) -> Tensor:
        """(3, 3) base of the arm in the world."""
        rotation = BASES[choice("robot.base", self.config.robot.base, tuple(BASES))]
        return torch.tensor(rotation, dtype=self.dtype, device=self.device)

    def backbone(self) -> KinematicModel:
        """The kinematic model."""
        m = self.config.model
        return kinematic_model(m.kind, self.n_sections, self.base_rotation(), m.settings)

    def sensors_at(self) -> Tensor:
        """(k,) sensor abscissae, m."""
        return self.vector("robot.sensors", self.config.robot.sensors)

    def routing(self, layout: str | None = None) -> TendonRouting:
        """Tendons of the model, or with another layout those of the plant."""
        robot: RobotConfig = self.config.robot
        racks = self.vector("robot.racks", robot.racks)
        return rack_routing(
            racks, robot.tendon_offset, robot.tendons_per_rack, robot.rack_twist, layout or robot.layout
        )

    def controller(self, adaptive: bool | None = None) -> APCCController:
        """The controller; `adaptive` overrides the setting."""
        c = self.config
        backbone = self.backbone()
        n_b = self.n_sections

        def given(key: str, values: Sequence[float] | None) -> Tensor | None:
            return None if values is None else self.vector(key, values, n_b)

        law = AdaptiveLaw(
            n_b,
            self.gain("controller.gamma", c.controller.gamma, n_b, c.adaptation.gain_scale),
            c.adaptation.regressor,
            given("adaptation.lower", c.adaptation.lower),
            given("adaptation.upper", c.adaptation.upper),
            c.adaptation.rate,
            c.adaptation.normalisation,
            c.adaptation.dead_zone,
            self._reach(c.adaptation.reach),
        )
        f = c.feedback
        feedback = StateFeedback(
            backbone,
            self.sensors_at(),
            mode=f.mode,
            angular_weight=f.angular_weight,
            max_iterations=f.max_iterations,
            min_iterations=f.min_iterations,
            linear_threshold=f.linear_threshold,
            angular_threshold=f.angular_threshold,
            bend_step=f.bend_step,
            length_step=f.length_step,
            damping=f.damping,
            settled_step=f.settled_step,
        )
        k = c.controller
        inverse_kinematics = InverseKinematics(
            self.gain("controller.K", k.K, 3),
            k.damping,
            k.null_gain,
            k.epsilon,
            k.bend_rate,
            k.length_rate,
            backbone.coordinates,
            given("controller.null_weights", k.null_weights),
            given("controller.null_bends", k.null_bends),
            k.null_step,
            k.null_speed,
        )
        gains = given("residual.gains", c.residual.gains)
        return APCCController(
            backbone,
            feedback,
            SavitzkyGolay(c.velocity_filter.window, c.velocity_filter.order),
            inverse_kinematics,
            law,
            routing=self.routing(),
            adaptive=k.adaptive if adaptive is None else adaptive,
            velocity=c.velocity_filter.velocity,
            bend_bound=k.bend_bound,
            elongation_bound=k.elongation_bound,
            residual_law=residual_law(c.residual, feedback, self.first_estimate(), gains),
            pose_filter=self._pose_filter(),
            integral=self._integral(),
        )

    def _integral(self) -> TaskIntegral | None:
        """Integral action on the task error; None where its gain is zero."""
        k = self.config.controller
        integral = TaskIntegral(k.integral_gain, k.integral_reach)
        return integral if is_used(integral.gain) else None

    def _pose_filter(self) -> PoseFilter | None:
        """The filter of the sensors' poses; None where neither a time nor the delay is above zero."""
        p = self.config.pose_filter
        poses = PoseFilter(p.angular_time, p.linear_time, p.follow, p.delay)
        used = poses.delay > 0 or is_used(poses.angular_time) or is_used(poses.linear_time)
        return poses if used else None

    def _reach(self, reach: Setting | None) -> Setting | None:
        """`adaptation.reach` as the law takes it; of several runs (P, 1, n_b), the reach of all sections last."""
        if not isinstance(reach, Tensor):
            return reach
        return torch.nn.functional.pad(reach.unsqueeze(-1), (self.n_sections - 1, 0))

    def sine(self) -> SineTrajectory:
        """Eq. (51)'s trajectory."""
        e = self.config.experiment
        if e.r_0 is None or e.A is None:
            raise ConfigError("experiment.r_0 and experiment.A must be given for a sine trajectory")
        omega = 0.2 * pi if e.omega is None else e.omega
        return SineTrajectory(self.vector("experiment.r_0", e.r_0, 3), self.vector("experiment.A", e.A, 3), omega)

    def setpoints(self) -> Tensor:
        """(S, 3) set-points of the chosen subset, m; of several runs with their own (P, S, 3)."""
        points = self.config.experiment.setpoints
        if isinstance(points, Tensor):
            return points[:, SUBSETS[choice("experiment.subset", self.config.experiment.subset, tuple(SUBSETS))]]
        if not points:
            raise ConfigError("experiment.setpoints must list at least one point [x, y, z]")
        subset = choice("experiment.subset", self.config.experiment.subset, tuple(SUBSETS))
        chosen = list(enumerate(points))[SUBSETS[subset]]
        if not chosen:
            raise ConfigError(f"experiment.subset={subset} leaves none of {len(points)} set-points")
        return torch.stack([self.vector(f"experiment.setpoints[{i}]", p, 3) for i, p in chosen])

    def payloads(self) -> Tensor:
        """(L,) payloads, kg; of several runs (P, L)."""
        payloads = self.vector("experiment.payloads", self.config.experiment.payloads)
        if payloads.dim() > 1:
            payloads = payloads.squeeze(-2)
        if payloads.shape[-1] == 0 or not bool((payloads >= 0).all()):
            raise ConfigError(f"experiment.payloads must be zero or positive, got {self.config.experiment.payloads}")
        return payloads if self.points is None else payloads.expand(self.points, -1)

    def grid(self) -> tuple[SetPoint, Tensor]:
        """Every set-point with every payload: (S L, 3) targets, payload fastest, and (S L,) payloads."""
        points, payloads = self.setpoints(), self.payloads()
        rows = points.repeat_interleave(payloads.shape[-1], dim=-2)
        return SetPoint(rows), payloads.repeat(*[1] * (payloads.dim() - 1), points.shape[-2])

    def dynamics(self) -> SoftArmDynamics:
        """The true arm's dynamics."""
        p: PlantConfig = self.config.plant
        lengths = self.vector("plant.lengths", p.lengths)
        axial, bending = scaled_stiffness(
            lengths,
            aligned(p.stiffness_reference, 1),
            aligned(p.axial_stiffness, 1),
            aligned(p.bending_stiffness, 1),
            p.stiffness_rule,
        )
        masses = aligned(p.mass, 1) * lengths / lengths.sum(-1, keepdim=True)
        return SoftArmDynamics(
            lengths, masses, axial, bending, damping_ratio=p.damping_ratio, base_rotation=self.base_rotation()
        )

    def plant(self, payload: Tensor) -> Plant:
        """The true arm with its tendons and their PID loop, one row a payload."""
        p = self.config.plant
        pid = TendonPID(p.K_P, p.K_I, p.K_D, p.force_limit)
        routing = self.routing(p.layout)
        transmission = None
        if p.friction > 0 or p.slack:
            transmission = TendonTransmission(routing, p.friction, p.slack)
        return Plant(self.dynamics(), routing, pid, payload, p.tendon_damping, transmission)

    def pose_sensors(self) -> PoseSensors:
        """What stands between the true poses and the controller."""
        s = self.config.sensors
        # Runs side by side have one seed, and each sees what it would see alone.
        shared = 0 if self.points is None else 1
        return PoseSensors(s.position_noise, s.angular_noise, s.delay, s.dropout, shared)
