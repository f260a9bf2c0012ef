"""python -m apcc_torch.simulate: run one experiment, or sweep it, from the configurations in conf/."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from apcc_torch.completion import answered
from apcc_torch.composition.arguments import options_first
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.data_file import data_override
from apcc_torch.composition.help import describe, for_manual
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words
from apcc_torch.composition.unread import check_given, of_a_simulation
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import one_sentence
from apcc_torch.experiments.folder import metrics_text
from apcc_torch.experiments.run import objective_in, run, settings_of
from apcc_torch.plain_text import plain_logger
from apcc_torch.sweeps import batch_run as batch
from apcc_torch.sweeps.batch_points import batch_points, with_batch
from apcc_torch.sweeps.callback import Sweep
from apcc_torch.sweeps.claim import check_options, given, held_folder, refusals
from apcc_torch.sweeps.job import run_job
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.simulate")

keep_schema("simulate_schema", SimulateSettings)
CHOICE = "experiment=kinematic"
"""Without it not every key is there: what `--help` and TAB take where none is made."""
EXPERIMENTS = (
    *("kinematic", "dynamic_run_1", "dynamic_run_2", "dynamic_run_2_tuned", "dynamic_run_2_composite"),
    *("dynamic_single", "tracking", "robot_2", "robot_2_tuned", "robot_2_single", "setpoint", "replay"),
)
describe("simulate", SimulateSettings, unread=of_a_simulation, experiments=EXPERIMENTS, choice=CHOICE)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="simulate")
def _hydra_main(cfg: DictConfig) -> float | None:
    """One run, or one job of a sweep; returns the objective, which hydra's sweepers lower."""
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    overrides = given()
    points = None
    if cfg.batch is not None:
        points = partial(batch_points, cfg, overrides, str(hydra_config.job.config_name))
    if hydra_config.mode == RunMode.MULTIRUN:
        return run_job(cfg, folder, overrides, f"{hydra_config.job.name}.log", points)
    with one_sentence(log.error):
        config = settings_of(cfg, folder)
        if points is None:
            check_given(of_a_simulation, [config], overrides)
        metrics = run(config, folder) if points is None else batch.run(config, points(), folder)
        value = objective_in(folder, config.objective)
    log.info("results in %s\n%s", folder, metrics_text(metrics))
    return value


def main() -> None:
    """Console entry point."""
    if answered("simulate", sys.argv[1:]):
        return
    with held_folder(Sweep):
        try:
            with refusals("simulate"):
                check_words(sys.argv[1:], SimulateSettings, "simulate")
                words = data_override(for_manual(sys.argv[1:], CHOICE), SimulateSettings)
                words = with_batch(arm_override(words))
                sys.argv[1:] = options_first(words)
                check_options("simulate")
                _hydra_main()
        except (Exception, SystemExit):  # a stop is told in a word
            Sweep.close()
            raise
        code = Sweep.close()
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
