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

from apcc_torch.evaluation.leaderboard import Score
from apcc_torch.evaluation.payload import Estimate
from apcc_torch.files import write_atomically
from apcc_torch.report.evaluation import Leaderboard

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
    for folder in folders:
        table = json.loads((folder / "table.json").read_text(encoding="utf-8"))
        found = boards.setdefault(table["data"], {})
        found |= {(score.task, score.method, score.session, score.body): score for score in scores(table)}
        if table["payload"]:
            weighed[table["data"]] = [Estimate(**estimate) for estimate in table["payload"]]
    told = (Leaderboard(name, [*found.values()], weighed.get(name, []), []) for name, found in boards.items())
    return "\n".join(f"### {board.title}\n\n{board.markdown()}\n" for board in told)


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
