"""python -m apcc_torch.robot: one experiment on an arm, real or simulated, in real time."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from apcc_torch.completion import answered
from apcc_torch.composition.arguments import options_first
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.help import describe, for_manual
from apcc_torch.composition.realtime import RealtimeSettings, of_a_realtime_run
from apcc_torch.composition.schema import check_words
from apcc_torch.composition.unread import check_given
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import one_sentence
from apcc_torch.experiments.folder import metrics_text
from apcc_torch.hardware.stops import exit_code_table
from apcc_torch.paper import arm_series as arm_run
from apcc_torch.plain_text import plain_logger
from apcc_torch.sweeps.claim import check_options, given, held_folder, refusals
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.robot")


keep_schema("realtime_schema", RealtimeSettings)
CHOICE = "experiment=setpoint"
"""Without it not every key is there: what `--help` and TAB take where none is made."""
EXPERIMENTS = (
    "setpoint",
    "calibration",
    "experiment_1",
    "experiment_2",
    "dynamic_single",
    "robot_2_single",
    "tracking",
)
describe("robot", RealtimeSettings, "realtime", of_a_realtime_run, EXPERIMENTS, choice=CHOICE)
OmegaConf.register_new_resolver("exit_codes", exit_code_table, replace=True)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="realtime")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        check_given(of_a_realtime_run, arm_run.planned(cfg), given())
        outcome, metrics = arm_run.run(cfg, folder)
    level = logging.ERROR if outcome.reason.failed else logging.INFO
    log.log(level, "%s: %s; the arm is %s", outcome.reason.value, outcome.message, outcome.state.value)
    if metrics:
        log.info("results in %s\n%s", folder, metrics_text(metrics))
    sys.exit(outcome.exit_code)


def main() -> None:
    """Console entry point."""
    if answered("robot", sys.argv[1:]):
        return
    with held_folder(), refusals("robot"):
        check_words(sys.argv[1:], RealtimeSettings, "realtime")
        sys.argv[1:] = options_first(arm_override(for_manual(sys.argv[1:], CHOICE)))
        check_options("robot")
        _hydra_main()


if __name__ == "__main__":
    main()
