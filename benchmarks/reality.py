"""The leaderboard in docs/reality.md: `python benchmarks/reality.py FOLDER...` writes it between its two marks.

A FOLDER is that of an evaluation. Those of one data set, such as of some methods each, make one chapter:

    python -m apcc_torch.evaluate data=trunk_payload hydra.run.dir=FOLDER
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from page import between

from apcc_torch.evaluation.coverage import Covered
from apcc_torch.evaluation.leaderboard import Score
from apcc_torch.evaluation.method import BOTH, LEARNING, PHYSICS
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.evaluation.payload import Estimate
from apcc_torch.files import write_atomically
from apcc_torch.report.evaluation import Leaderboard
from apcc_torch.report.text_table import as_markdown

FAMILIES = (PHYSICS, LEARNING, BOTH)
PAGE = Path(__file__).resolve().parent.parent / "docs" / "reality.md"
BEGIN, END = "<!-- reality: python benchmarks/reality.py FOLDER... -->", "<!-- /reality -->"


def scores(table: dict[str, Any]) -> Iterable[Score]:
    """The scores of a table.json."""
    for task, methods in table["tasks"].items():
        for method, row in methods.items():
            for session, bodies in row["sessions"].items():
                for body, found in bodies.items():
                    number = int(body.removeprefix("body_"))
                    folds = tuple(found["folds_mm"])
                    yield Score(task, method, row["family"], session, number, folds, row["seconds"])


def chapters(folders: Iterable[Path]) -> str:
    """A chapter a data set; of what several of its folders hold, that of the last one counts."""
    boards: dict[str, dict[tuple[object, ...], Score]] = {}
    weighed: dict[str, list[Estimate]] = {}
    honest: dict[str, list[Covered]] = {}
    for folder in folders:
        table = json.loads((folder / "table.json").read_text(encoding="utf-8"))
        found = boards.setdefault(table["data"], {})
        found |= {(score.task, score.method, score.session, score.body): score for score in scores(table)}
        if table["payload"]:
            weighed[table["data"]] = [Estimate(**estimate) for estimate in table["payload"]]
        if table["coverage"]:
            honest[table["data"]] = [Covered(**each) for each in table["coverage"]]
    told = (
        Leaderboard(name, [*found.values()], weighed.get(name, []), [], honest.get(name, []))
        for name, found in boards.items()
    )
    return "\n".join(chapter(board) for board in told)


def chapter(board: Leaderboard) -> str:
    """The best of each family, what was weighed, how honest the intervals are, and every method to unfold."""
    lines = [["from", "body", *FAMILIES], *(best(board, task) for task in dict.fromkeys(s.task for s in board.scores))]
    parts = [f"### {board.title}", as_markdown(lines)]
    if board.payloads or board.coverage:
        parts.append(board._replace(scores=[], failures=[]).markdown())
    every = board._replace(payloads=[], coverage=[], failures=[]).markdown()
    parts += ['<details markdown="1">', f"<summary>Every method on {board.title}</summary>", every, "</details>"]
    return "\n\n".join(parts) + "\n"


def best(board: Leaderboard, task: str) -> list[str]:
    """A line of the task's last body: of each family the method whose errors over all bodies are least, by session."""
    own = [score for score in board.scores if score.task == task]
    last = max(score.body for score in own)
    cells = []
    for family in FAMILIES:
        totals: dict[str, float] = {}
        for score in own:
            if score.family == family and not getattr(METHODS.get(score.method), "hindsight", False):
                totals[score.method] = totals.get(score.method, 0.0) + score.mean
        if not totals:
            cells.append("")
            continue
        method = min(totals, key=lambda name: totals[name])
        found = " / ".join(f"{score.mean:.2f}" for score in own if score.method == method and score.body == last)
        cells.append(f"{method}: {found}")
    return [task, str(last), *cells]


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folders", type=Path, nargs="+", help="of evaluations, in the order in which the page shows them"
    )
    folders = parser.parse_args().folders
    text = PAGE.read_text(encoding="utf-8")
    write_atomically(PAGE, between(text, BEGIN, END, "\n" + chapters(folders)))


if __name__ == "__main__":
    main()
