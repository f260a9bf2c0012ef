"""python -m apcc_torch.benchmark: section V-B and Appendix A whole, one table beside the paper's, and the figures."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import hydra
import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.completion import answered
from apcc_torch.composed import initialised
from apcc_torch.composition.arguments import options_first
from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.benchmark import (
    BenchmarkSettings,
    ComparisonSettings,
    GridSettings,
    OverrideSettings,
    RowSettings,
)
from apcc_torch.composition.help import describe
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words, sentence, typed
from apcc_torch.composition.unread import Unread, check_given, of_a_simulation
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError, one_sentence
from apcc_torch.files import write_atomically
from apcc_torch.paper import benchmark_run as paper
from apcc_torch.paper.outcomes import Row
from apcc_torch.plain_text import plain_logger
from apcc_torch.reading import plain
from apcc_torch.settings import check_names, names
from apcc_torch.sweeps.claim import check_options, held_folder, refusals
from apcc_torch.sweeps.schemas import keep_schema

log = plain_logger("apcc_torch.benchmark")

keep_schema("benchmark_schema", BenchmarkSettings)
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


def rows(config: BenchmarkSettings, comparison: ComparisonSettings, run: str) -> dict[str, Row]:
    """The settings of one run's rows, cut to the grid: its two controllers', or the laws' that it compares.

    Raises:
        ConfigError: A setting has no meaning, or rows that are to differ in their law alone differ in more.
    """
    pair, changes = comparison.runs[run], config.experiments
    check_names(f"changes of {run}", pair.changes, tuple(comparison.rows) or paper.CONTROLLERS)
    of_side = {"standard": changes.standard, "adaptive": changes.adaptive}
    found: dict[str, Row] = {}
    for row in comparison.rows or paper.CONTROLLERS:
        base = pair.standard if row == "standard" else pair.adaptive
        law = comparison.rows.get(row)
        own = () if law is None else law.settings
        # The last one of a key counts: what the command line says is said of all that stands here.
        here = (*comparison.common, *pair.common, *own, *pair.changes.get(row, ()))
        every = (*here, *changes.common, *of_side.get(row, ()))
        settings = list({setting.partition("=")[0]: setting for setting in every}.values())
        adaptive = row == "adaptive" if law is None else None
        composed = experiment(base, settings)
        check_kept("experiments.common", changes.common, config.grid, law, (*own, *pair.changes.get(row, ())))
        check_kept(f"experiments.{row}", of_side.get(row, ()), config.grid, law)
        cut = paper.on_grid(composed, config.grid, adaptive)
        found[row] = Row(cut, None if law is None else law.searched)
    if comparison.rows:
        paper.check_laws(run, found)
    return found


def check_kept(
    who: str, words: tuple[str, ...], grid: GridSettings, law: RowSettings | None, own: tuple[str, ...] = ()
) -> None:
    """Raises ConfigError where the command line sets a key of a row that the benchmark sets after it.

    Args:
        who: The key of the benchmark's that holds the words.
        words: Settings of an experiment, which hydra has taken.
        grid: Its payloads and its duration take the place of the experiment's.
        law: The row in which nothing but the law differs; None for one of the two controllers.
        own: What makes the row what it is, and must not be the same in all of them.
    """
    kept = {key: f"the row itself does with {each}" for each in own for key in keys_set(each)}
    if law is None:
        kept["controller.adaptive"] = (
            "the comparison itself does: its rows are the standard controller and the adaptive"
        )
    elif law.searched == "gamma":
        kept["adaptation.gamma"] = "the row itself does: it is searched for"
    for name in ("payloads", "duration"):
        if getattr(grid, name) is not None:
            kept[f"experiment.{name}"] = f"grid.{name} does: change that, or make it null"
    for word in words:
        for key in keys_set(word):
            for name, does in kept.items():
                if f"{name}.".startswith(f"{key}."):
                    raise ConfigError(f"{who} must not set {key}, {does}")


def keys_set(word: str) -> Iterator[str]:
    """The keys that a word of a command line sets: a group's, or those of the values that it spells out."""
    override = OverridesParser.create().parse_override(word)
    yield from leaves(override.key_or_group.replace("/", "."), override.value())


def leaves(key: str, value: object) -> Iterator[str]:
    """The keys of a value's leaves."""
    if not isinstance(value, dict) or not value:
        yield key
        return
    for name, each in value.items():
        yield from leaves(f"{key}.{name}", each)


def compose_grids(config: BenchmarkSettings) -> paper.Grids:
    """The experiments' settings: comparison -> run -> row.

    Raises:
        ConfigError: A setting has no meaning.
    """
    with initialised():
        grids = {
            name: {run: rows(config, comparison, run) for run in comparison.runs}
            for name, comparison in config.grid.comparisons.items()
        }
    for who in names(OverrideSettings):
        given = getattr(config.experiments, who)
        of_it = [
            row.config
            for runs in grids.values()
            for every in runs.values()
            for name, row in every.items()
            if who in ("common", name)
        ]
        if given and not of_it:
            raise ConfigError(f"experiments.{who} is read by nothing: no run of this grid has a row of that name")
        check_given(of_a_row, of_it, given)
    return grids


def of_a_row(config: SimulateSettings) -> Unread:
    """What a run of the benchmark does not read."""
    yield from of_a_simulation(config)
    alone = "overwrite resume jobs progress threads figures objective prune"
    yield f"{alone} batch", "the benchmark runs its grids itself: see its own keys"


def run(cfg: DictConfig, folder: Path) -> str:
    """Runs the benchmark into `folder` and returns its table as text."""
    config = typed(cfg, BenchmarkSettings)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    grids = compose_grids(config)
    settings = {
        comparison: {name: {who: plain(row.config) for who, row in every.items()} for name, every in runs.items()}
        for comparison, runs in grids.items()
    }
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml({"benchmark": plain(config), "runs": settings}))
    return paper.run(config, grids, folder)


@hydra.main(version_base="1.3", config_path=conf_path(), config_name="benchmark")
def _hydra_main(cfg: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    with one_sentence(log.error):
        words = run(cfg, folder)
    log.info("results in %s\n%s", folder, words)


def main() -> None:
    """Console entry point."""
    if answered("benchmark", sys.argv[1:]):
        return
    with held_folder(), refusals("benchmark"):
        check_words(sys.argv[1:], BenchmarkSettings, "benchmark")
        sys.argv[1:] = options_first(sys.argv[1:])
        check_options("benchmark")
        _hydra_main()


if __name__ == "__main__":
    main()
