"""python -m apcc_torch.identify: fit an arm's parameters to a recording, and say what they are worth."""

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
from apcc_torch.composition.help import describe, for_manual
from apcc_torch.composition.identify import IdentifySettings, of_a_fit
from apcc_torch.composition.schema import check_words, typed
from apcc_torch.composition.unread import check_given
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import one_sentence
from apcc_torch.experiments import identification
from apcc_torch.plain_text import plain_logger
from apcc_torch.sweeps.claim import check_options, given, held_folder, refusals
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.identify")

keep_schema("identify_schema", IdentifySettings)
CHOICE = "arm=ftdcr_v6"
"""Without it not every key is there: what `--help` and TAB take where none is made."""
describe("identify", IdentifySettings, unread=of_a_fit, choice=CHOICE)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="identify")
def _hydra_main(cfg: DictConfig) -> float:
    """One recording; returns the identified arm's tip error on what was held back, mm."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        settings = typed(cfg, IdentifySettings)
        check_given(of_a_fit, [settings], given())
        metrics, text = identification.run(settings, folder, log.info if settings.progress else log.debug)
    log.info("results in %s\n%s", folder, text)
    return metrics["arm_identified_tip_rmse_mm"]


def main() -> None:
    """Console entry point."""
    if answered("identify", sys.argv[1:]):
        return
    with held_folder(), refusals("identify"):
        check_words(sys.argv[1:], IdentifySettings, "identify")
        words = for_manual(sys.argv[1:], CHOICE)
        sys.argv[1:] = options_first(arm_override(data_override(words, IdentifySettings)))
        check_options("identify")
        _hydra_main()


if __name__ == "__main__":
    main()
