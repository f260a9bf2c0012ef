"""python -m apcc_torch.report: any set of finished runs as a ranked summary, tables, and one HTML page."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tqdm import tqdm

from apcc_torch.bars import terminal_bar
from apcc_torch.composition.arguments import Arguments
from apcc_torch.errors import DataError, in_a_line, one_sentence
from apcc_torch.experiments.redrawing import draw_anew
from apcc_torch.files import write_atomically
from apcc_torch.processes import stoppable
from apcc_torch.report import pictures
from apcc_torch.report.collect import collect
from apcc_torch.report.page.html import Page
from apcc_torch.report.pictures import Picture
from apcc_torch.report.ranking import HIGHER_IS_BETTER, choose_metric, ranked, remarks, summary, without_effect
from apcc_torch.report.run_record import COMPLETE, Run
from apcc_torch.report.run_table import RunTable, differing, has_parquet, line, tidy, write_csv, write_parquet
from apcc_torch.report.style import failures_told

PICTURE_BYTES = 10_000_000
"""Room for figures and films in a page; the best and the worst runs' come first."""
MANUAL = """\
RUNS are folders of runs, whole sweeps, batches, or folders of any of them. What is left in the first one:

  runs.csv       one row a run: name, status, swept keys, metrics, wall time, note; numbers to their last digit
  runs.parquet   the same for pandas, polars or DuckDB; needs pyarrow (pip install "apcc-torch[report]")
  report.html    one file for any browser, without network: table, sensitivity, best and worst run, figures, a film

Figures are those that a run left in its folder; a few of the best and the worst runs that left none are drawn anew.
A run that failed, was killed or cannot be read is listed with why. Benchmark folders are passed over: they have their
own table.

examples:
  python -m apcc_torch.simulate -m experiment=kinematic controller.null_gain=0.5,1,2 adaptation.gain_scale=0.1,0.3,1
  python -m apcc_torch.report runs/sweep/DATE                          that sweep, best shape error first
  python -m apcc_torch.report runs/sweep/* --out all                   every sweep in one table, written into all/
  python -m apcc_torch.report runs/sweep/DATE --metric psi_mean_cm     ranked by another metric
  python -m apcc_torch.report runs/sweep/DATE --top 3 --no-page        the table only, in a second
"""


def illustrate(folder: Path, filmed: bool) -> list[Picture]:
    """The figures that the run left, else drawn from its trajectory; with a film where one is wanted.

    Raises:
        DataError: There is nothing to show, or it cannot be read.
    """
    figures, film = pictures.stored(folder), pictures.stored_film(folder)
    if not figures or (filmed and film is None):
        with tempfile.TemporaryDirectory() as scratch:
            draw_anew(folder, Path(scratch), not figures, filmed)
            figures = figures or pictures.stored(Path(scratch))
            film = film or pictures.stored_film(Path(scratch))
    return [*figures, film] if filmed and film is not None else figures


def from_both_ends(order: Sequence[int]) -> Iterator[int]:
    """Best, worst, second best, second worst, …"""
    half = -(-len(order) // 2)
    for best, worst in zip(order[:half], reversed(order[half:]), strict=False):
        yield from (best, worst)
    if len(order) % 2:
        yield order[half - 1]


def illustrate_all(
    runs: Sequence[Run], order: Sequence[int], most: int, films: int, fresh: int
) -> dict[int, list[Picture]]:
    """Row -> pictures of up to `most` runs, the first `films` of them with a film, while there is room in a page.

    At most `fresh` runs that left no figures are drawn anew, which takes seconds each; the best and the worst first.

    A run that cannot be illustrated is told on the terminal, and the others go on.
    """
    candidates = [(row, folder) for row in from_both_ends(order) if (folder := runs[row].folder) is not None]
    shown_by_row: dict[int, list[Picture]] = {}
    room = PICTURE_BYTES
    bare = [row for row, folder in candidates if not any((folder / "figures").glob("*.png"))]
    chosen = [(row, folder) for row, folder in candidates if row not in bare[fresh:]]
    for count, (row, folder) in enumerate(terminal_bar(chosen[:most], desc="figures", unit="run")):
        try:
            with failures_told(partial(_warn_of, runs[row])):
                shown = illustrate(folder, count < films)
        except Exception as error:  # of one run; arrays that fit neither settings nor each other fail in any way
            warn(f"{runs[row].name} is shown without figures: {in_a_line(error)}")
            continue
        room -= sum(len(picture.uri) for picture in shown)
        if room < 0:
            break
        if shown:
            shown_by_row[row] = shown
    return shown_by_row


def _warn_of(run: Run, said: str) -> None:
    warn(f"{run.name}: {said}")


def default_title(runs: Sequence[Run], table: RunTable) -> str:
    """What was swept, in a line."""
    experiments = dict.fromkeys(
        str(run.settings["experiment.name"]) for run in runs if "experiment.name" in run.settings
    )
    swept = [column.name for column in differing(table)]
    what = " and ".join(experiments) if 0 < len(experiments) < 3 else f"{len(table)} runs"
    if not swept:
        return f"{what}: {runs[0].name}" if len(runs) == 1 else what
    return f"{what} over " + (" and ".join(swept) if len(swept) < 4 else f"{len(swept)} settings")


def footer(runs: Sequence[Run]) -> str:
    """Versions that all runs share, as a line; those in which they differ are said to differ."""
    known: dict[str, set[str]] = {}
    for run in runs:
        for name, version in run.versions.items():
            known.setdefault(line(name), set()).add(line(str(version)))
    told = [f"{name} {used.pop()}" if len(used) == 1 else f"{name} differs" for name, used in known.items()]
    return "Computed with " + ", ".join(told) + "." if told else ""


def warn(text: str) -> None:
    """One line on the terminal's error stream, above any progress bar."""
    tqdm.write(line(text), file=sys.stderr)


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    about = "Collects runs into one table, ranks them, and writes a page to explore them."
    parser = Arguments.described("report", about, MANUAL)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUNS", help="folders of runs, sweeps or batches")
    parser.add_argument("--metric", help="metric that ranks (default: shape_error_mean_mm, where the runs have it)")
    parser.add_argument("--descending", action="store_true", help="the largest value is the best")
    parser.add_argument("--top", type=int, default=10, metavar="N", help="runs the terminal shows (default: 10)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the files go (default: the first of RUNS)")
    parser.add_argument("--title", help="heading of the page (default: what was swept)")
    parser.add_argument("--figures", type=int, default=24, metavar="N", help="runs shown with figures (default: 24)")
    parser.add_argument("--draw", type=int, default=4, metavar="N", help="of them, runs drawn anew (default: 4)")
    parser.add_argument("--films", type=int, default=2, metavar="N", help="of them, runs with a film (default: 2)")
    parser.add_argument("--no-page", action="store_true", help="tables only")
    given = parser.parse_args(argv)
    for name in ("top", "figures", "draw", "films"):
        if getattr(given, name) < (name == "top"):
            parser.error(f"--{name} must be {'one' if name == 'top' else 'zero'} or more, got {getattr(given, name)}")
    return given


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Raises DataError where a file cannot be written into the folder."""
    try:
        yield
    except OSError as error:
        raise DataError(f"--out must be a folder to write into, but {folder}: {in_a_line(error)}") from error


def report(given: argparse.Namespace) -> list[Path]:
    """Collects, prints the summary and writes the files; returns their paths.

    Raises:
        ApccError: There is no run, or an argument has no meaning.
    """
    collection = collect(given.runs, lambda folders: terminal_bar(folders, desc="reading", unit="run"))
    for passed_over in collection.skipped:
        warn(passed_over)
    runs = collection.runs
    table = tidy(runs)
    out: Path = given.out or given.runs[0]
    with writing_to(out):
        written = [write_csv(table, out / "runs.csv")]
        if has_parquet():
            written.append(write_parquet(table, out / "runs.parquet"))
    if not has_parquet():
        warn('runs.parquet is not written, it needs pyarrow: pip install "apcc-torch[report]"; runs.csv holds the same')
    if all(run.status != COMPLETE for run in runs):
        sys.stdout.write("\n".join(remarks(table)[1:]) + "\n\n")
    metric = choose_metric(table, given.metric)
    descending = given.descending or metric in HIGHER_IS_BETTER
    sys.stdout.write(summary(table, metric, given.top, descending, shutil.get_terminal_size((120, 24)).columns) + "\n")
    if not given.no_page:
        shown_by_row = illustrate_all(runs, ranked(table, metric, descending), given.figures, given.films, given.draw)
        folders = [row for row, run in enumerate(runs) if run.folder is not None and run.status == COMPLETE]
        title = given.title or default_title(runs, table)
        foot = f"{without_effect(table)} {footer(runs)}".strip()
        page = Page(title, table, metric, descending, shown_by_row, folders, foot)
        with writing_to(out):
            written.append(write_atomically(out / "report.html", page.html()))
    return written


def main(argv: Sequence[str] | None = None) -> None:
    """Console entry point."""
    with stoppable(lambda by: warn(f"stopped by {by}")), one_sentence(warn):
        written = report(arguments(argv))
    sys.stdout.write("\nwritten: " + ", ".join(line(str(path)) for path in written) + "\n")


if __name__ == "__main__":
    main()
