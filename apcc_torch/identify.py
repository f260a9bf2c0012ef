"""python -m apcc_torch.identify: fit an arm's parameters to a recording, and say what they are worth."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from apcc_torch.composition.identify import IdentifyConfig, arm_of
from apcc_torch.composition.typed import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError
from apcc_torch.experiments import identification

log = logging.getLogger("apcc_torch.identify")

ConfigStore.instance().store(name="identify_schema", node=IdentifyConfig)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="identify")
def _hydra_main(cfg: DictConfig) -> float:
    """One recording; returns the identified arm's tip error on what was held back, mm."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        config = typed(cfg, IdentifyConfig)
        metrics, text = identification.run(config, folder, log.info if config.progress else log.debug)
    except ApccError as error:
        # A wrong setting or file is the user's to mend: one sentence, no stack.
        log.error("%s", error)
        sys.exit(2)
    log.info("results in %s\n%s", folder, text)
    return metrics["arm_identified_tip_rmse_mm"]


def with_arm(arguments: Sequence[str]) -> list[str]:
    """The arguments with the arm that the recording is known to be of, where they name none.

    Raises:
        ApccError: The recording is of no arm that conf/arm knows, or cannot be read.
    """
    if any(argument.startswith(("arm=", "--config-name", "-cn")) for argument in arguments):
        return list(arguments)
    if {"-h", "--help"} & set(arguments):
        # The manual ends with every key and its value, and only a chosen arm has them all.
        return [*arguments, "arm=ftdcr_v6"]
    data = next((argument.removeprefix("data=") for argument in arguments if argument.startswith("data=")), None)
    return list(arguments) if data is None else [*arguments, f"arm={arm_of(data)}"]


def main() -> None:
    """Console entry point."""
    try:
        sys.argv[1:] = with_arm(sys.argv[1:])
    except ApccError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    _hydra_main()


if __name__ == "__main__":
    main()
