"""The pairs of `apcc_torch.benchmark`, standard and adaptive, for programs that put both to something else."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping

import torch
from hydra import compose, initialize_config_dir
from tqdm import tqdm

from apcc_torch.benchmark import compose_grids
from apcc_torch.composition.benchmark import BenchmarkSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path

COMPILED = 'experiments.common=["compile=aot"]'


def compare(
    description: str | None,
    measured: Callable[[SimulateSettings, bool], Mapping[str, float]],
    titles: Mapping[str, str],
) -> None:
    """Prints a line a pair, with what both controllers reach; the command line gives settings of the benchmark.

    Args:
        description: Of the program, for --help.
        measured: From a controller's settings, and whether it adapts, to numbers by name.
        titles: Name of a number to its column's title.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="*", help="of apcc_torch.benchmark; at first " + COMPILED)
    settings = parser.parse_args().settings
    torch.set_num_threads(1)
    with initialize_config_dir(conf_path(), version_base="1.3"):
        grids = compose_grids(typed(compose("benchmark", [COMPILED, *settings]), BenchmarkSettings))
    runs = {f"{name}, {run}": both for name, comparison in grids.items() for run, both in comparison.items()}
    lines = [f"{'':<12}" + "".join(f"{title:>26}" for title in titles.values())]
    for name, both in tqdm(runs.items(), desc="comparisons"):
        standard, adaptive = measured(both["standard"].config, False), measured(both["adaptive"].config, True)
        line = f"{name:<12}"
        for key in titles:
            old, new = standard[key], adaptive[key]
            change = f" ({100.0 * (new / old - 1.0):+.0f} %)" if old else ""
            line += f"{f'{old:.2f} -> {new:.2f}{change}':>26}"
        lines.append(line)
    print(*lines, sep="\n")
