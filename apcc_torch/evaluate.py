"""python -m apcc_torch.evaluate: how well this toolkit and others know a real arm, on recordings of it."""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from apcc_torch.completion import answered
from apcc_torch.composition.arguments import options_first
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.data_file import data_override
from apcc_torch.composition.evaluate import EvaluateSettings
from apcc_torch.composition.help import describe, for_manual
from apcc_torch.composition.identify import of_a_fit
from apcc_torch.composition.schema import check_words, typed
from apcc_torch.composition.unread import check_given
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import one_sentence
from apcc_torch.experiments import evaluation
from apcc_torch.plain_text import plain_logger
from apcc_torch.sweeps.claim import check_options, given, held_folder, refusals
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.evaluate")

keep_schema("evaluate_schema", EvaluateSettings)
CHOICE = "data=trunk_payload"
"""Without it not every key is there: what `--help` and TAB take where none is made."""
describe("evaluate", EvaluateSettings, unread=of_a_fit, choice=CHOICE)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="evaluate")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        settings = typed(cfg, EvaluateSettings)
        check_given(of_a_fit, [settings], given())
        text = evaluation.run(settings, folder, log.debug)
    log.info("results in %s\n%s", folder, text)


def main() -> None:
    """Console entry point."""
    if answered("evaluate", sys.argv[1:]):
        return
    with held_folder(), refusals("evaluate"):
        check_words(sys.argv[1:], EvaluateSettings, "evaluate")
        sys.argv[1:] = options_first(arm_override(data_override(for_manual(sys.argv[1:], CHOICE))))
        check_options("evaluate")
        _hydra_main()


if __name__ == "__main__":
    main()
