"""A sweep from hydra's side: a callback that prepares its folder, draws its bars, and tells how it ended."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import typed
from apcc_torch.composition.unread import check_given, of_a_simulation
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError, Checks, ConfigError, DataError
from apcc_torch.experiments.run import PRUNED, objective_in
from apcc_torch.plain_text import plain_logger
from apcc_torch.processes import again
from apcc_torch.sweeps.bars import SweepBars
from apcc_torch.sweeps.batch_points import points_of
from apcc_torch.sweeps.claim import Claim, dir_override, given, or_no_run
from apcc_torch.sweeps.job import HEAD
from apcc_torch.sweeps.sweep_folder import FAILED, NOT_THE_RUN, Failure, SweepFolder, read_job, read_record

log = plain_logger("apcc_torch.simulate")

# Meant: our launchers' values, checked against their plugins' types.
warnings.filterwarnings("ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema")

EXTRAS = {
    "hydra_joblib_launcher": "sweep",
    "hydra_optuna_sweeper": "sweep",
    "hydra_submitit_launcher": "cluster",
    "hydra_ray_launcher": "ray",
}
"""Plugin of hydra -> the extra of this package that installs it."""
JOBLIB = "hydra_plugins.hydra_joblib_launcher"
OF_THIS_MACHINE = ("JoblibLauncher", "LocalLauncher")
"""Launchers whose workers end with the sweep; a cluster's go on, and Ray ends its own."""


@dataclass(frozen=True)
class Plan:
    """What a sweep will run.

    total: Number of jobs.
    keys: What it sweeps.
    jobs: The overrides of each; None where they are found on the way.
    """

    total: int
    keys: frozenset[str]
    jobs: list[list[str]] | None

    def brief(self, overrides: Iterable[str]) -> str:
        """A job's overrides without what all jobs share."""
        own = [override for override in overrides if override.partition("=")[0].lstrip("+~") in self.keys]
        return " ".join(own) or "(nothing swept)"


def planned(config: DictConfig) -> Plan:
    """The jobs that hydra's sweeper will make of the command line and the chosen sweep."""
    overrides, swept = _sweeps(config)
    keys = frozenset(swept)
    trials = config.hydra.sweeper.get("n_trials")
    if trials is not None:
        return Plan(int(trials), keys, None)
    jobs = [job for batch in BasicSweeper.split_arguments(overrides, None) for job in batch]
    return Plan(len(jobs), keys, jobs)


def _sweeps(config: DictConfig) -> tuple[list[Override], dict[str, Override]]:
    """The overrides of the command line and the chosen sweep, and the sweeps among them by what they sweep."""
    params = [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]
    overrides = OverridesParser.create().parse_overrides([*params, *given(config.hydra)])
    last = {override.get_key_element().lstrip("+~"): override for override in overrides}
    return overrides, {key: override for key, override in last.items() if override.is_sweep_override()}


def check_jobs(config: DictConfig) -> None:
    """Raises ConfigError or ValueRangeError where a job's settings have no meaning.

    A search draws its own: of it the ends of each range and each choice are tried, the others as they are.
    """
    overrides, swept = _sweeps(config)
    if any(key.startswith("hydra") for key in swept):
        check_given(of_a_simulation, [typed(config, SimulateSettings)], [str(o.input_line) for o in overrides])
        return
    fixed = [str(o.input_line) for o in overrides if o.get_key_element().lstrip("+~") not in swept]
    name = str(config.hydra.job.config_name)
    if config.hydra.sweeper.get("n_trials") is None:
        points_of(config, fixed, name, swept.values())
        return
    checks = Checks()
    for override in swept.values():
        with checks.one():
            points_of(config, fixed, name, [_tried(override)])
    checks.end()


def _tried(override: Override) -> Override:
    """What a search may draw of a key, as a sweep: its choices, or the ends of its interval."""
    ends = override.value()
    if not isinstance(ends, IntervalSweep):
        return override
    return OverridesParser.create().parse_override(f"{override.get_key_element()}={ends.start},{ends.end}")


def check_installed(target: str) -> None:
    """Refuses a launcher or sweeper that is not installed.

    Args:
        target: Its class, by its full name.

    Raises:
        ConfigError: With the command that installs it, where it is one of the package's extras.
    """
    top, _, rest = target.partition(".")
    if top != "hydra_plugins":
        return  # hydra's own
    plugin = rest.partition(".")[0]
    if not installed(f"{top}.{plugin}"):
        extra = EXTRAS.get(plugin)
        advice = f"; pip install 'apcc-torch[{extra}]' brings it" if extra else ""
        raise ConfigError(f"{top}.{plugin} is not installed{advice}")


def side_by_side(config: DictConfig) -> None:
    """Takes joblib instead of the basic launcher where it is installed, no launcher was asked for and jobs is not 1."""
    asked = any(override.startswith("hydra/launcher=") for override in config.hydra.overrides.hydra)
    basic = str(config.hydra.launcher._target_).endswith(".BasicLauncher")
    if basic and not asked and config.jobs != 1 and installed(JOBLIB):
        with read_write(config), open_dict(config):
            config.hydra.launcher = OmegaConf.load(Path(conf_path()) / "hydra" / "launcher" / "joblib.yaml")


def installed(plugin: str) -> bool:
    """Whether there is a plugin of hydra's of this full name."""
    # Without any plugin there is no package hydra_plugins, of which find_spec could name a part.
    return find_spec(plugin.partition(".")[0]) is not None and find_spec(plugin) is not None


def prepare(folder: SweepFolder, config: DictConfig) -> None:
    """Makes a folder ready for a sweep to begin, or to go on.

    Raises:
        ConfigError: It holds finished jobs, and the sweep was asked neither to resume nor to write over them.
    """
    there = list(folder.finished())
    if there and not config.resume and not config.overwrite:
        raise ConfigError(
            f"{folder.path} holds finished jobs; resume=true runs only what is missing, overwrite=true begins anew"
        )
    folder.clear()
    for job in there if not config.resume else ():
        folder.discard(job)


@dataclass
class OpenSweep:
    """A sweep that runs.

    folder: Its folder.
    plan: What it will run.
    objective: The metric that a search lowers.
    bars: Its bars.
    ended: Whether hydra went through it to the end.
    """

    folder: SweepFolder
    plan: Plan
    objective: str | None
    bars: SweepBars
    ended: bool = False

    def stopped(self, by: str) -> None:
        """Tells how far the sweep has come, and how to go on."""
        self.bars.stop()
        failed = len(self.folder.failures())
        log.error(
            "stopped by %s: %d of %d jobs are finished in %s%s",
            *(by, len(list(self.folder.finished())), self.plan.total, self.folder.path),
            f", {failed} failed" if failed else "",
        )
        log.info("to run only what is missing: %s", self.resume())

    def resume(self) -> str:
        """The command that goes on with the sweep, for a shell."""
        return again("resume=true", dir_override("hydra.sweep.dir", self.folder.path))

    def _known(self, failure: Failure) -> Failure:
        """A failure whose record is lost, with the overrides that the sweep's plan has under its number."""
        number, jobs = failure.folder.name.removesuffix(FAILED), self.plan.jobs or []
        if failure.overrides or not number.isdecimal() or int(number) >= len(jobs):
            return failure
        return failure._replace(overrides=jobs[int(number)])

    def close(self) -> int:
        """Names the jobs that failed, were pruned or never ran, and the best one; returns the exit code."""
        self.bars.stop()
        finished = sorted(self.folder.finished(), key=lambda folder: (len(folder.name), folder.name))
        overrides = {folder: read_job(folder)["overrides"] for folder in finished}
        brief = {folder: self.plan.brief(overrides[folder]) for folder in finished}
        failures = [self._known(failure) for failure in self.folder.failures()]
        for folder in finished:
            if (folder / PRUNED).is_file():
                log.info("pruned: %s, %s: %s", folder.name, brief[folder], _why_pruned(folder))
        for failure in failures:
            log.error("failed: %s, %s: %s", failure.folder.name, self.plan.brief(failure.overrides), failure.why)
        known = {job_key(o) for o in [*overrides.values(), *(failure.overrides for failure in failures)]}
        missing = [job for job in self.plan.jobs or () if job_key(job) not in known]
        for job in missing:
            log.error("not finished: %s", self.plan.brief(job))
        if self.objective is not None and finished:
            values = {folder: _objective(folder, self.objective) for folder in finished}
            best = min(finished, key=lambda folder: values[folder])
            if math.isfinite(values[best]):
                log.info("best %s: %.6g, in %s, %s", self.objective, values[best], best.name, brief[best])
        log.info("%d finished jobs in %s", len(finished), self.folder.path)
        if self.ended and not failures and not missing:
            return 0
        log.info("to run only what is missing: %s", self.resume())
        return 1


class Sweep(Claim):
    """Hydra's view of a sweep. Launchers copy callbacks into their workers, so what runs here is the class's."""

    current: ClassVar[OpenSweep | None] = None
    batch: ClassVar[Path | None] = None
    """Folder of a batch that is no job of a sweep: it can be resumed."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """See `Claim.on_run_start`."""
        super().on_run_start(config)
        Sweep.batch = None if config.batch is None else Path(str(config.hydra.run.dir))

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Checks what can be checked, clears the folder, starts the bars."""
        with or_no_run():
            side_by_side(config)
            for plugin in (config.hydra.launcher, config.hydra.sweeper):
                check_installed(str(plugin._target_))
            check_jobs(config)
            if config.resume and not Path(str(config.hydra.sweep.dir)).is_dir():
                raise ConfigError(
                    "resume=true needs hydra.sweep.dir=FOLDER of the sweep to resume; "
                    f"{config.hydra.sweep.dir} is not there"
                )
            folder = SweepFolder(self.take(config, "hydra.sweep.dir", None))
            prepare(folder, config)
        plan = planned(config)
        before = sum(1 for _ in folder.finished())
        launcher = str(config.hydra.launcher._target_).rpartition(".")[2]
        there = f", which holds {before}" if before else ""
        log.info("%d jobs by %s into %s%s", plan.total, launcher, folder.path, there)
        if launcher in OF_THIS_MACHINE:
            os.environ[HEAD] = str(os.getpid())
        Sweep.current = OpenSweep(folder, plan, config.objective, SweepBars(folder, plan.total))
        if config.progress:
            Sweep.current.bars.start()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Notes that the sweep did not break off."""
        if Sweep.current is not None:
            Sweep.current.ended = True

    @classmethod
    def stopped(cls, by: str) -> None:
        """See `Claim.stopped`."""
        sweep, Sweep.current = Sweep.current, None
        if sweep is not None:
            sweep.stopped(by)
        elif cls.batch is not None:
            log.error("stopped by %s; what is finished of the batch is kept in %s", by, cls.batch)
            log.info("to go on: %s", again("resume=true", dir_override("hydra.run.dir", cls.batch)))
        else:
            super().stopped(by)

    @staticmethod
    def close() -> int:
        """Ends the sweep, if there was one; returns the exit code that it asks for."""
        sweep, Sweep.current = Sweep.current, None
        return 0 if sweep is None else sweep.close()


def _why_pruned(folder: Path) -> str:
    try:
        return str(read_record(folder / PRUNED, "why")["why"])
    except DataError as error:
        return str(error)


def _objective(folder: Path, name: str) -> float:
    """A finished job's objective; infinite where it cannot be read."""
    try:
        return objective_in(folder, name) or 0.0
    except ApccError as error:
        log.error("%s: %s", folder.name, error)
        return math.inf


def job_key(overrides: Iterable[str]) -> frozenset[str]:
    """What tells jobs of one sweep apart, in whatever order it was given."""
    return frozenset(override for override in overrides if override.partition("=")[0] not in NOT_THE_RUN)
