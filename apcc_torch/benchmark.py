"""python -m apcc_torch.benchmark: section V-B and Appendix A whole, one table beside the paper's, and the figures."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import hydra
import torch
from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composed import initialised
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.benchmark import BenchmarkSettings, PairSettings
from apcc_torch.composition.help import describe
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words, schema, sentence, typed
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError, one_sentence
from apcc_torch.files import write_atomically
from apcc_torch.paper import benchmark_run as paper
from apcc_torch.plain_text import for_terminal
from apcc_torch.reading import plain
from apcc_torch.sweeps.claim import held_folder, refusals

log = logging.getLogger("apcc_torch.benchmark")

ConfigStore.instance().store(name="benchmark_schema", node=schema(BenchmarkSettings))
describe("benchmark", BenchmarkSettings)


def experiment(name: str, overrides: list[str]) -> SimulateSettings:
    """An experiment of apcc_torch.simulate with some of its settings changed. Hydra must be initialised.

    Raises:
        ConfigError: There is no such experiment, key or choice, or a value has the wrong type.
    """
    try:
        return typed(compose("simulate", [f"experiment={name}", *arm_override(overrides)]), SimulateSettings)
    except (HydraException, OmegaConfBaseException) as error:
        changed = f" with {', '.join(overrides)}" if overrides else ""
        raise ConfigError(f"experiment {name}{changed}: {sentence(error)}") from error


def pair(config: BenchmarkSettings, names: PairSettings) -> paper.Pair:
    """Both controllers' settings of one run, cut to the grid.

    Raises:
        ConfigError: A setting has no meaning.
    """
    changes = config.experiments
    standard = experiment(names.standard, [*changes.common, *changes.standard])
    adaptive = experiment(names.adaptive, [*changes.common, *changes.adaptive])
    return paper.Pair(paper.on_grid(standard, config.grid, False), paper.on_grid(adaptive, config.grid, True))


def compose_pairs(config: BenchmarkSettings) -> paper.Pairs:
    """The experiments' settings: comparison -> run -> both controllers'.

    Raises:
        ConfigError: A setting has no meaning.
    """
    with initialised():
        return {
            name: {run: pair(config, names) for run, names in comparison.runs.items()}
            for name, comparison in config.grid.comparisons.items()
        }


def run(cfg: DictConfig, folder: Path) -> str:
    """Runs the benchmark into `folder` and returns its table as text."""
    config = typed(cfg, BenchmarkSettings)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    pairs = compose_pairs(config)
    settings = {
        comparison: {name: {who: plain(c) for who, c in both._asdict().items()} for name, both in runs.items()}
        for comparison, runs in pairs.items()
    }
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml({"benchmark": plain(config), "runs": settings}))
    return paper.run(config, pairs, folder)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="benchmark")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        words = run(cfg, folder)
    log.info("results in %s\n%s", for_terminal(str(folder)), words)


def main() -> None:
    """Console entry point."""
    with held_folder(), refusals("benchmark"):
        check_words(sys.argv[1:], BenchmarkSettings, "benchmark")
        _hydra_main()


if __name__ == "__main__":
    main()
