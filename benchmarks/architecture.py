"""The picture of the rooms: `python benchmarks/architecture.py` writes docs/images/architecture.png.

The rows are LAYERS of tests/test_layers.py, and the words those of the tables in docs/architecture.md. What was drawn
is written into the picture too, so that a test can tell whether it is still right.
"""

from __future__ import annotations

import argparse
import json
import re
import runpy
import textwrap
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parent.parent
TEST, PAGE = ROOT / "tests" / "test_layers.py", ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "images" / "architecture.png"
SURFACE = "apcc_torch"
"""The name of the package itself, whose unit is "" in LAYERS."""
TINTS = ("#dbe9f6", "#e3f1e1", "#fdeedb", "#f7e1e6", "#ece6f5", "#dff1f0", "#f5f2d8", "#e8e8e8")
WIDTH, LEFT, GAP, INDENT, LINE = 9.2, 1.75, 0.07, 1.5, 0.165
"""Inches."""
PER_INCH = 16.5
"""Letters of the words that fit into an inch."""


def tables() -> tuple[list[list[str]], dict[str, list[str]]]:
    """LAYERS from the bottom up, the package itself by its name; and room -> the restricted libraries it may import."""
    layers = runpy.run_path(str(TEST))
    rows = [[unit or SURFACE for unit in row] for row in layers["LAYERS"]]
    allowed = {room: [name for name, of in layers["RESTRICTED"].items() if room in of] for row in rows for room in row}
    return rows, allowed


def words() -> dict[str, tuple[str, str]]:
    """Room -> the heading of its table in docs/architecture.md, and what the table says that it holds."""
    by_room, heading = {}, ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.lstrip("# ")
        elif row := re.fullmatch(r"\| `([\w.]+)` \| (.+) \|", line):
            by_room[row[1]] = (heading, row[2].replace("`", ""))
    return by_room


def source() -> list[list[list[str]]]:
    """What is drawn, from the bottom up: rows of rooms, each its name, its heading, its words and its libraries.

    Raises:
        LookupError: docs/architecture.md has no line for a room.
    """
    told, (rows, allowed) = words(), tables()
    missing = [room for row in rows for room in row if room not in told]
    if missing:
        raise LookupError(f"{PAGE} has no line for {', '.join(missing)}")
    return [[[room, *told[room], ", ".join(allowed[room])] for room in row] for row in rows]


def draw(rows: list[list[list[str]]]) -> Figure:
    """A row a layer, the lowest at the bottom; rooms under one heading have one colour."""
    headings = list(dict.fromkeys(heading for row in reversed(rows) for _, heading, _, _ in row))
    placed = []
    for row in rows:
        width = (WIDTH - LEFT - 0.1 - GAP * (len(row) - 1)) / len(row)
        # A room that is alone in its row has its words beside its name, the others below it.
        indent, above = (INDENT, 0) if len(row) == 1 else (0.09, 1)
        words = [textwrap.wrap(about, int((width - indent - 0.1) * PER_INCH)) for _, _, about, _ in row]
        lines = max(
            above + len(text) + (above if allowed else 0) for text, (*_, allowed) in zip(words, row, strict=True)
        )
        placed.append((width, indent, above, words, 0.16 + LINE * lines))
    height = sum(high for *_, high in placed) + GAP * len(rows) + 0.1
    figure = Figure(figsize=(WIDTH, height), dpi=150)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(0.0, WIDTH), ylim=(0.0, height))
    ax.axis("off")
    bottom, spans = 0.08, dict[str, tuple[float, float]]()
    for row, (width, indent, above, words, high) in zip(rows, placed, strict=True):
        top = bottom + high - 0.08
        for k, ((name, heading, _, allowed), text) in enumerate(zip(row, words, strict=True)):
            x = LEFT + k * (width + GAP)
            tint = TINTS[headings.index(heading) % len(TINTS)]
            corners = "round,pad=0,rounding_size=0.05"
            ax.add_patch(FancyBboxPatch((x, bottom), width, high, corners, fc=tint, ec="#8a8a8a", lw=0.6))
            mono = {"fontsize": 8.5, "fontweight": "bold", "family": "DejaVu Sans Mono"}
            # A room that is a program too is that in the row of programs.
            ax.text(x + 0.09, top, name.removesuffix(".__main__"), va="top", color="#222222", **mono)
            ax.text(x + indent, top - above * LINE, "\n".join(text), va="top", fontsize=8, color="#333333")
            if allowed:
                below = above * LINE * (1 + len(text))
                ax.text(x + width - 0.09, top - below, allowed, va="top", ha="right", fontsize=7.5, color="#8a2f2f")
            spans[heading] = (spans.get(heading, (bottom, 0.0))[0], bottom + high)
        bottom += high + GAP
    for heading, (low, high) in spans.items():
        label = textwrap.fill(heading, 15)
        ax.text(LEFT - 0.2, (low + high) / 2, label, va="center", ha="right", fontsize=9, color="#222222")
        ax.plot([LEFT - 0.12] * 2, [low, high], color="#8a8a8a", lw=1.2)
    arrow = {"arrowstyle": "-|>", "color": "#555555", "lw": 1.2}
    ax.annotate("", (0.32, 0.1), (0.32, height - 0.1), arrowprops=arrow)
    ax.text(0.16, height / 2, "imports point down", rotation=90, va="center", ha="center", fontsize=9, color="#555555")
    return figure


def main() -> None:
    """Draws it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default=str(PICTURE), help="where the picture goes (default: %(default)s)")
    options, rows = parser.parse_args(), source()
    FigureCanvasAgg(draw(rows)).print_png(options.out, metadata={"Source": json.dumps(rows)})


if __name__ == "__main__":
    main()
