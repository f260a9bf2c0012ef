"""python -m apcc_torch.simulate: run one experiment, or sweep it, from the configurations in conf/."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
import torch
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from apcc_torch.conf_path import conf_path
from apcc_torch.configs.build import choice
from apcc_torch.configs.schema import SimulateConfig
from apcc_torch.configs.typed import typed
from apcc_torch.errors import ApccError
from apcc_torch.experiments import dynamic, kinematic, replay
from apcc_torch.files import write_atomically

log = logging.getLogger("apcc_torch.simulate")

EXPERIMENTS: dict[str, Callable[[SimulateConfig, Path], dict[str, float]]] = {
    "dynamic": dynamic.run,
    "kinematic": kinematic.run,
    "replay": replay.run,
}

ConfigStore.instance().store(name="simulate_schema", node=SimulateConfig)


def run(cfg: DictConfig, folder: Path) -> dict[str, float]:
    """Runs the configured experiment into `folder` and returns its metrics."""
    config = typed(cfg, SimulateConfig)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    kind = choice("experiment.kind", config.experiment.kind, tuple(EXPERIMENTS))
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    return EXPERIMENTS[kind](config, folder)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="simulate")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        metrics = run(cfg, folder)
    except ApccError as error:
        # A wrong setting is the user's to mend: one sentence, no stack.
        log.error("%s", error)
        sys.exit(2)
    width = max(len(name) for name in metrics)
    lines = "\n".join(f"  {name:<{width}}  {value:.6g}" for name, value in metrics.items())
    log.info("results in %s\n%s", folder, lines)


def main() -> None:
    """Console entry point."""
    asked = sys.argv[1:]
    if {"-h", "--help"} & set(asked) and not any(argument.startswith("experiment=") for argument in asked):
        # The manual ends with every key and its value, and only a chosen experiment has them all.
        sys.argv.append("experiment=kinematic")
    _hydra_main()


if __name__ == "__main__":
    main()
