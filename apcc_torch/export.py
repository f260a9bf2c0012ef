"""python -m apcc_torch.export: an arm's controller as a C++ library without torch."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from apcc_torch.completion import answered
from apcc_torch.composition.arguments import options_first
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.export import ExportSettings, of_an_export
from apcc_torch.composition.help import describe
from apcc_torch.composition.schema import check_words, typed
from apcc_torch.composition.unread import check_given
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import one_sentence
from apcc_torch.experiments import exported
from apcc_torch.plain_text import plain_logger
from apcc_torch.sweeps.claim import check_options, dir_override, given, held_folder, refusals
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.export")

keep_schema("export_schema", ExportSettings)
describe("export", ExportSettings, unread=of_an_export)
OUT = "out="


def out_override(words: Sequence[str]) -> list[str]:
    """A command line with `out=DIR` as hydra takes it.

    Example:
        >>> out_override(["arm=arm_2", "out=my_library"])
        ['arm=arm_2', 'hydra.run.dir=my_library']
    """
    return [
        dir_override("hydra.run.dir", Path(word.removeprefix(OUT))) if word.startswith(OUT) else word for word in words
    ]


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="export")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        settings = typed(cfg, ExportSettings)
        check_given(of_an_export, [settings], given())
        said = exported.run(settings, folder)
    log.info("%s", said)


def main() -> None:
    """Console entry point."""
    if answered("export", sys.argv[1:]):
        return
    with held_folder(), refusals("export"):
        words = out_override(sys.argv[1:])
        check_words(words, ExportSettings, "export")
        sys.argv[1:] = options_first(arm_override(words))
        check_options("export")
        _hydra_main()


if __name__ == "__main__":
    main()
