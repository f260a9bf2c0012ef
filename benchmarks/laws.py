"""Comparison C in the pages: `python benchmarks/laws.py FOLDER` fills in README.md and docs/adaptation.md.

FOLDER is that of a benchmark, of all of it or of comparison C alone:

    python -m apcc_torch.benchmark figures=false hydra.run.dir=FOLDER '~grid.comparisons.A' '~grid.comparisons.B'
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from page import between

from apcc_torch.files import write_atomically
from apcc_torch.paper.law_rows import LOST, all_lost, law_rows
from apcc_torch.paper.printed_numbers import TITLES
from apcc_torch.report.text_table import as_markdown

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- laws: python benchmarks/laws.py FOLDER -->", "<!-- /laws -->"
HELD_OUT = "_held_out"
SHORT = ("shape_error_mean_mm", "psi_mean_cm", "end_effector_error_end_mm")
"""The README's numbers of a run."""

Cells = Mapping[str, Mapping[str, float | None]]


def short(table: Mapping[str, Cells], about: Mapping[str, str]) -> str:
    """The README's table: a line a law, a column a run, on the held-out set-points."""
    runs = [run for run in TITLES if run + HELD_OUT in table]
    lines = [["shape error mm / Psi cm / tip mm", *(TITLES[run].partition(":")[0] for run in runs)]]
    for row, meaning in about.items():
        lines.append([meaning, *(cell(table[run + HELD_OUT], row) for run in runs)])
    return as_markdown(lines)


def cell(cells: Cells, row: str) -> str:
    """A law's numbers in one run, and how many of its runs diverged; where all did there are no numbers."""
    if all_lost({name: cells[name][row] for name in (LOST, "rows")}):
        return "all diverge"
    told = " / ".join("-" if v is None else f"{v:.2f}" for v in (cells[metric][row] for metric in SHORT))
    lost = cells[LOST][row]
    return f"{told}, {lost:.0f} of {cells['rows'][row]:.0f} diverge" if lost else told


def whole(table: Mapping[str, Cells], found: Mapping[str, Any], about: Mapping[str, str]) -> str:
    """All tables, a run and its held-out twin each, with what was searched."""
    parts = []
    for run, cells in table.items():
        base = run.removesuffix(HELD_OUT)
        if base not in TITLES:
            continue
        held_out = ", held-out set-points" if run.endswith(HELD_OUT) else ""
        parts += [f"**{TITLES[base]}{held_out}**", as_markdown(law_rows(cells, about))]
        if not held_out and found.get(base):
            told = ", ".join(f"{about[row]}: {spelled(each)}" for row, each in found[base].items())
            parts.append(f"Searched on the training set-points: {told}.")
    return "\n\n".join(parts)


def spelled(found: Mapping[str, Any]) -> str:
    """What was found, over the nominal lengths or as Gamma."""
    values = ", ".join(f"{value:.3g}" for value in found["value"])
    return f"Gamma {values}" if len(found["value"]) == 1 else f"({values}) of the nominal lengths"


def main() -> None:
    """Writes both pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a benchmark")
    parser.add_argument("--comparison", default="C", help="default: %(default)s")
    options = parser.parse_args()
    read = {name: json.loads((options.folder / f"{name}.json").read_text()) for name in ("table", "searched")}
    table, found = (each[options.comparison] for each in read.values())
    grid = OmegaConf.load(options.folder / "config.yaml").benchmark.grid
    about = {row: law.about for row, law in grid.comparisons[options.comparison].rows.items()}
    pages = {"README.md": short(table, about), "docs/adaptation.md": whole(table, found, about)}
    for page, text in pages.items():
        path = ROOT / page
        write_atomically(path, between(path.read_text(encoding="utf-8"), BEGIN, END, text))


if __name__ == "__main__":
    main()
