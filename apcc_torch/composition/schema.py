"""What a run can be set to, with its types. Values and meanings stand in conf/; a wrong key or type is refused."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass
class RobotConfig:
    """What the controller believes about the arm: its sections, sensors and tendons."""

    rest_lengths: list[float] = MISSING
    initial_estimate: list[float] | None = None
    base: str = "hanging"
    sensors: list[float] = MISSING
    racks: list[float] = MISSING
    tendon_offset: float = 0.027
    tendons_per_rack: int = 3
    rack_twist: float = 0.5235987755982988
    layout: str = "coupled"


@dataclass
class ModelConfig:
    """The kinematic model of the robot: a class, and its own settings."""

    kind: str = "apcc_torch.model.backbone.PCCBackbone"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class PlantConfig:
    """The true arm."""

    lengths: list[float] = MISSING
    mass: float = 1.0
    axial_stiffness: float = 100.0
    bending_stiffness: float = 0.778
    stiffness_reference: float = 0.1
    stiffness_rule: str = "series"
    damping_ratio: float = 0.1
    layout: str = "coupled"
    K_P: float = 750.0
    K_I: float = 1.0
    K_D: float = 5.0
    force_limit: float | None = None
    tendon_damping: float = 200.0
    friction: float = 0.0
    slack: bool = False
    substeps: int = 2
    settle: float = 3.0


@dataclass
class SensorsConfig:
    """What the sensors add to the truth."""

    position_noise: float = 0.0
    angular_noise: float = 0.0
    delay: int = 0
    dropout: float = 0.0


@dataclass
class FeedbackConfig:
    """Algorithm 2."""

    mode: str = "pose"
    angular_weight: float = 1.0
    max_iterations: int = 7
    min_iterations: int = 1
    linear_threshold: float = 1e-4
    angular_threshold: float = 5e-3
    bend_step: float = 0.6
    length_step: float = 0.1
    damping: float = 1e-8
    settled_step: float = 5e-6


@dataclass
class PoseFilterConfig:
    """The filter of the sensors' poses before algorithm 2."""

    angular_time: float = 0.0
    linear_time: float = 0.0
    follow: float = 0.8
    delay: int = 0


@dataclass
class VelocityFilterConfig:
    """The Savitzky-Golay filter and which velocity the regressor uses."""

    window: int = 15
    order: int = 2
    velocity: str = "measured"


@dataclass
class ControllerConfig:
    """Inverse kinematics and the gains."""

    adaptive: bool = True
    rate: float = 100.0
    K: Any = 1.0
    gamma: Any = 1.0
    damping: float = 1e-3
    null_gain: float = 0.2
    epsilon: float = 5e-3
    null_weights: list[float] | None = None
    null_bends: list[float] | None = None
    null_step: float | None = None
    null_speed: float | None = None
    integral_gain: float = 0.0
    integral_reach: float = 1e-3
    bend_rate: float | None = None
    length_rate: float | None = None
    bend_bound: float | None = None
    elongation_bound: float | None = None


@dataclass
class AdaptationConfig:
    """The law."""

    regressor: str = "estimator_aware"
    gain_scale: float = 1.0
    lower: list[float] | None = None
    upper: list[float] | None = None
    rate: float | None = None
    normalisation: float = 0.0
    dead_zone: float = 0.0
    reach: float | None = None


@dataclass
class ResidualConfig:
    """The law of the sensors' residuals."""

    target: str | None = None
    tangents: str | None = None
    samples: int = 8
    angular_weight: float = 0.0
    time_constant: float = 0.3
    elongation_weight: float = 0.05
    nominal_weight: float = 0.02
    total_weight: float = 0.0
    damping: float = 0.05
    excitation: float = 0.0
    memory: float = 0.0
    rate: float = 0.1
    gains: list[float] | None = None
    shares: list[Any] = field(default_factory=lambda: [0.4, 0.55, 0.7, 0.85, 1.0, 1.15])
    sharpness: float = 0.1
    resolution: float = 3e-5
    stretch: float = 0.0
    total_range: float = 0.1


@dataclass
class DynamicsLawConfig:
    """The feed-forward of the tendon loop, and the law of its parameters."""

    kind: str = "none"
    bending_rigidity: float = 0.0778
    axial_rigidity: float = 10.0
    tendon_damping: float = 200.0
    payload: float = 0.0
    mass: float = 1.0
    bending_rigidity_deviation: float = 0.02
    axial_rigidity_deviation: float = 3.0
    tendon_damping_deviation: float = 50.0
    payload_deviation: float = 0.3
    mass_deviation: float = 0.0
    lower: list[float] | None = None
    upper: list[float] | None = None
    damping_ratio: float = 0.1
    stiffness: float = 3.0
    damping: float = 0.0
    reference_time: float = 0.1
    force_limit: float | None = None
    tracking_gain: float = 1.0
    prediction: bool = True
    filter_time: float = 0.3
    memory: float = 2.0
    torque_noise: float = 0.2
    length: float = 0.1
    dead_zone: float = 0.0


@dataclass
class ReplayConfig:
    """How a recording is read."""

    layout: str = "auto"
    rate: float = 100.0
    direction: list[float] | None = None
    forward: list[float] | None = None
    base_position: list[float] | None = None
    first_abscissa: float | None = None
    frames: int | None = None
    gate: dict[str, Any] = field(default_factory=dict)


@dataclass
class ExperimentConfig:
    """What is run."""

    name: str = MISSING
    kind: str = MISSING
    duration: float = 10.0
    r_0: list[float] | None = None
    A: list[float] | None = None
    omega: float | None = None
    # Rows of three numbers; typed, OmegaConf would refuse an integer in a row.
    setpoints: list[Any] | None = None
    payloads: list[float] = field(default_factory=lambda: [0.0])
    subset: str = "all"
    start_errors: int = 0
    start_error: float = 0.15


@dataclass
class PruneConfig:
    """Which runs a search ends early."""

    after: float | None = None
    above: float | None = None


@dataclass
class ArmConfig:
    """What a run has, in simulation and on an arm alike."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    plant: PlantConfig = field(default_factory=PlantConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    pose_filter: PoseFilterConfig = field(default_factory=PoseFilterConfig)
    velocity_filter: VelocityFilterConfig = field(default_factory=VelocityFilterConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)
    residual: ResidualConfig = field(default_factory=ResidualConfig)
    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
    seed: int = 0
    dtype: str = "float64"
    compile: str = "off"


@dataclass
class SimulateConfig(ArmConfig):
    """Root of `python -m apcc_torch.simulate`."""

    replay: ReplayConfig = field(default_factory=ReplayConfig)
    dynamics_law: DynamicsLawConfig = field(default_factory=DynamicsLawConfig)
    state: str = "feedback"
    data: str | None = None
    device: str = "cpu"
    threads: int | None = 1
    figures: bool = True
    progress: bool = True
    objective: str | None = None
    prune: PruneConfig = field(default_factory=PruneConfig)
    resume: bool = False
    jobs: int = 2
    # A list of texts, or one text; typed, OmegaConf would take one of them only.
    batch: Any = None
    batch_kept: int = 4
    batch_memory_mib: int = 4096
    batch_workers: int = 2
