"""The leaderboard in docs/reality.md: `python benchmarks/reality.py FOLDER...` writes it between its two marks.

A FOLDER is that of an evaluation, one a data set, in the order in which the page shows them:

    python -m apcc_torch.evaluate data=trunk_payload hydra.run.dir=FOLDER
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from page import between

from apcc_torch.files import write_atomically

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reality.md"
BEGIN, END = "<!-- reality: python benchmarks/reality.py FOLDER... -->", "<!-- /reality -->"


def chapter(folder: Path) -> str:
    """A data set's tables under its name."""
    name = json.loads((folder / "table.json").read_text(encoding="utf-8"))["data"]
    return f"### {name}\n\n{(folder / 'table.md').read_text(encoding='utf-8').strip()}\n"


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="of evaluations")
    folders = parser.parse_args().folders
    text = PAGE.read_text(encoding="utf-8")
    write_atomically(PAGE, between(text, BEGIN, END, "\n" + "\n".join(map(chapter, folders))))


if __name__ == "__main__":
    main()
