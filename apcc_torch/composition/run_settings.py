"""What a run can be set to: the root of `simulate`, and what `robot` shares with it. Keys are the parts' settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

import torch
from torch import Tensor

from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_gate import SensorGateSettings
from apcc_torch.model.arm import Arm, Lengths, vector
from apcc_torch.native.compiled import MODES
from apcc_torch.reading import keyed
from apcc_torch.recordings.data_set import DataSettings
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.settings import OURS, PAPER, Setting, Settings, setting
from apcc_torch.simulation.divergence import DivergenceSettings
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.sensors import PoseSensorsSettings
from apcc_torch.spread import Numbers, spread

Points = tuple[Any, ...]
"""Lists of three numbers, m; or a tensor, one set a row."""

FARTHEST = 3.0
"""How far off a target may be, in lengths of the arm: no arm stretches so far."""
ON_AN_ARM = ("hardware", "guards", "loop", "calibration", "ramp", "series", "dry_run", "view", "page", "stream", "log")
"""What a run in real time alone can be set to."""
LONGEST = 10_000_000
"""The most control periods that a simulation logs."""


@dataclass(frozen=True, kw_only=True)
class ExperimentSettings(Settings):
    """What is run."""

    name: str = setting(meaning="of the experiment")
    kind: str = setting(meaning="kinematic, dynamic or replay; on an arm also tendons or calibration")
    duration: float = setting(10.0, "s", PAPER, "of the run", above=0)
    r_0: Lengths | None = setting(None, "m", PAPER, "centre of the sine trajectory, Eq. (51)", rows="sections")
    A: Lengths | None = setting(None, "m", PAPER, "its amplitude", rows="sections")
    omega: Setting = setting(0.2 * pi, "rad/s", PAPER, "its angular frequency", rows="number", above=0)
    setpoints: Points | None = setting(None, "m", PAPER, "targets, lists of 3 numbers; null: the sine", rows="points")
    payloads: Lengths = setting(
        (0.0,), "kg", PAPER, "at the tip, one row each for every set-point", rows="sections", least=0, most=1000
    )
    subset: str = setting(
        "all",
        "",
        OURS,
        "of the set-points: all; training, those with even index; held_out, the others",
        choices=("all", "training", "held_out"),
    )
    first_estimate: Numbers = setting(
        1.0, "", PAPER, "pi_hat at the start over the arm's rest lengths", rows="sections", above=0
    )
    start_errors: int = setting(
        0, "", OURS, "extra rows with pi_hat(0) drawn around the rest lengths", least=0, most=10**6
    )
    start_error: float = setting(0.15, "", OURS, "their largest relative error", above=0, below=1)

    def check(self) -> None:
        """Raises ConfigError where a set-point is no point, the sine lacks a coordinate, or there is no payload."""
        for name, value in {"r_0": self.r_0, "A": self.A, **dict(self._points())}.items():
            if not isinstance(value, list | tuple | Tensor | None):
                raise ConfigError(f"{name} must be a list of 3 numbers, got {value!r}")
            if value is not None:
                spread(name, value, 3)
        if not vector(self.payloads).numel():
            raise ConfigError("payloads must hold at least one, kg")

    def _points(self) -> Iterator[tuple[str, Any]]:
        if not isinstance(self.setpoints, Tensor):
            yield from ((f"setpoints[{i}]", point) for i, point in enumerate(self.setpoints or ()))

    def farthest(self) -> dict[str, float]:
        """Distance of the farthest target from the base by the key that says so, m."""
        points = [spread(name, point, 3) for name, point in self._points()]
        rows = {
            "setpoints": self.setpoints
            if isinstance(self.setpoints, Tensor)
            else torch.stack(points or [torch.zeros(3)])
        }
        if self.r_0 is not None and self.A is not None:
            r_0, A = spread("r_0", self.r_0, 3), spread("A", self.A, 3)
            rows["r_0"] = torch.maximum((r_0 + A).norm(dim=-1, keepdim=True), (r_0 - A).norm(dim=-1, keepdim=True))
        return {name: float(targets.norm(dim=-1).max()) for name, targets in rows.items()}


@dataclass(frozen=True, kw_only=True)
class FolderSettings(Settings):
    """What every program does with its folder."""

    overwrite: bool = setting(False, "", OURS, "write over the results of an earlier run in the folder")


@dataclass(frozen=True, kw_only=True)
class RunSettings(FolderSettings, ControlSettings):
    """What a run has, in simulation and on an arm alike: the arm, its controller, the true arm, the experiment."""

    arm: Arm = setting(meaning="the arm, as it is believed to be")
    plant: PlantSettings = setting(factory=PlantSettings, meaning="the true arm of a simulation", base=Plant)
    sensors: PoseSensorsSettings = setting(
        factory=PoseSensorsSettings, meaning="what a simulation's sensors add to the truth"
    )
    experiment: ExperimentSettings = setting(meaning="what is run")
    divergence: DivergenceSettings = setting(factory=DivergenceSettings, meaning="which rows count as diverged")
    seed: int = setting(0, "", OURS, "of every random number in the run", least=0, most=2**63 - 1)
    dtype: str = setting("float64", "", OURS, "float64 or float32", choices=("float64", "float32"))
    compile: str = setting(
        "off",
        "",
        OURS,
        "the loop as: off, eager torch; aot, machine code, built once; auto, aot where it can be had; inductor",
        choices=MODES,
    )

    def check(self) -> None:
        """Raises where a target is far beyond the arm, or the plant's arm is none."""
        with keyed("plant"):
            self.plant.true_arm(self.arm)
        reach = FARTHEST * float(self.arm.rest_lengths().sum(-1).max())
        for key, distance in self.experiment.farthest().items():
            if distance > reach:
                raise ValueRangeError(
                    f"experiment.{key} must stay within {reach:.4g} m of the base, {FARTHEST:g} times the arm's "
                    f"length, got a target {distance:.4g} m away"
                )


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(Settings):
    """How a recording is replayed."""

    rest: int | None = setting(
        None, "", OURS, "frames at the start in which the arm rests; null: those before the inputs first move", least=1
    )
    direction: tuple[float, ...] | None = setting(
        None, "", OURS, "the way the resting arm points in the recording's frame; null: along its sensors"
    )
    forward: tuple[float, ...] | None = setting(
        None, "", OURS, "what the base's x axis follows in the recording's frame; null: the recording's x axis"
    )
    base_position: tuple[float, ...] | None = setting(
        None, "m", OURS, "in the recording's frame; null: one mean spacing before the first sensor"
    )
    first_abscissa: float | None = setting(
        None, "m", OURS, "from the base to the first sensor, instead of base_position", above=0
    )
    gate: SensorGateSettings = setting(factory=SensorGateSettings, meaning="which poses of a frame to believe")
    frames: int | None = setting(None, "", OURS, "replay only so many; null: all", least=1)


@dataclass(frozen=True, kw_only=True)
class PruneSettings(Settings):
    """Which runs a search ends early: pruned.json instead of metrics.json."""

    after: float | None = setting(
        None, "s", OURS, "of the run that are tried first; where a row diverges, that was it; null: no try", above=0
    )
    above: float | None = setting(None, "", OURS, "bound on the objective of the try, in its unit; null: none")


@dataclass(frozen=True, kw_only=True)
class ForcedRunSettings(RunSettings):
    """What a run has whose tendons may be told forces beside their lengths."""

    dynamics_law: Settings | None = setting(
        None, "", PAPER, "feed-forward of the tendon loop; null: none", base=CompositeController
    )


@dataclass(frozen=True, kw_only=True)
class SimulateSettings(ForcedRunSettings):
    """Root of `python -m apcc_torch.simulate`."""

    elsewhere: ClassVar[Mapping[str, str]] = dict.fromkeys(ON_AN_ARM, "python -m apcc_torch.robot")

    replay: ReplaySettings = setting(factory=ReplaySettings, meaning="of a recording")
    state: str = setting(
        "feedback", "", PAPER, "feedback, algorithm 2 in the loop; exact, q is known", choices=("feedback", "exact")
    )
    data: DataSettings = setting(factory=DataSettings, meaning="of a replay: data=NAME, data=FILE, data=FOLDER")
    data_root: str | None = setting(
        None, "", OURS, "folder that holds the data sets of conf/data_set; null: APCC_DATA, else they are fetched"
    )
    recording: RecordingSettings = setting(factory=RecordingSettings, meaning="how the recording is read")
    device: str = setting("cpu", "", OURS, "a torch device")
    threads: int | None = setting(
        1, "", OURS, "torch threads; small batches run fastest on one; null: torch's choice", least=1, most=1024
    )
    figures: bool = setting(True, "", OURS, "write the figures")
    progress: bool = setting(True, "", OURS, "show progress bars where there is a terminal")
    objective: str | None = setting(None, "", OURS, "the metric that a search lowers, a name in metrics.json")
    prune: PruneSettings = setting(factory=PruneSettings, meaning="end bad runs of a search early")
    resume: bool = setting(False, "", OURS, "with hydra.sweep.dir=FOLDER: run only what is missing there")
    jobs: int = setting(
        2, "", OURS, "jobs of a sweep side by side; 1: one after the other; -1: one a core", least=-1, most=1024
    )
    batch: Any = setting(None, "", OURS, 'sweeps as rows of one tensor batch: ["adaptation.gamma=10,20"]')
    batch_kept: int = setting(4, "", OURS, "of its points, best and worst, that keep a run folder each", least=0)
    batch_memory_mib: int = setting(4096, "MiB", OURS, "that its processes may take together, about", least=1)
    batch_workers: int = setting(2, "", OURS, "processes that share its chunks", least=1, most=1024)

    def check(self) -> None:
        """Raises where there is no such device, no job, or too long a run."""
        super().check()
        try:
            torch.device(self.device)
        except RuntimeError as error:
            raise ConfigError(f"device must be a torch device such as cpu or cuda, got {self.device!r}") from error
        if not self.jobs:
            raise ValueRangeError("jobs must be at least 1, or -1 for one a core, got 0")
        duration, rate = self.experiment.duration, self.controller.rate
        if not 1.0 <= round(duration * rate) <= LONGEST:
            raise ValueRangeError(
                f"experiment.duration must be from 1 to {LONGEST} periods of controller.rate, {1 / rate:g} s each, "
                f"got {duration:g} s"
            )
