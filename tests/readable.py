"""What a reader cannot read in a figure: texts that overlap, leave it, or are too small on a page."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

PAGE = 800.0
"""Pixels of a page of documentation; wider figures are scaled down to it."""
SMALLEST = 10.0
"""Height of the smallest type there, pixels."""
DPI = 100


def faults(figure: Figure) -> list[str]:
    """Each as a sentence; none of a figure that can be read.

    Args:
        figure: It is drawn.
    """
    drawn = texts_of(figure)
    width, height = figure.get_size_inches() * DPI
    told = []
    scale = min(1.0, PAGE / width)
    for text, size, box in drawn:
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1:
            told.append(f"{text!r} leaves the figure")
        pixels = size / 72.0 * DPI * scale
        if pixels < SMALLEST - 1e-6:
            told.append(f"{text!r} has {pixels:.1f} pixels on a page, {size:g} points")
    for (a, _, first), (b, _, second) in itertools.combinations(drawn, 2):
        if _shrunk(first).overlaps(_shrunk(second)):
            told.append(f"{a!r} overlaps {b!r}")
    return told


def texts_of(figure: Figure) -> list[tuple[str, float, Bbox]]:
    """Every text that is drawn: what it says, its size in points, and where it is, in pixels at `DPI`."""
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    with _recorded() as found:
        canvas.draw()
    return list(found.values())


def _shrunk(box: Bbox) -> Bbox:
    """Without the room that type leaves above and below its letters."""
    dx, dy = min(1.0, 0.1 * box.width), min(2.5, 0.15 * box.height)
    if box.height > box.width:  # upright
        dx, dy = dy, dx
    return Bbox.from_extents(box.x0 + dx, box.y0 + dy, box.x1 - dx, box.y1 - dy)


@contextmanager
def _recorded() -> Iterator[dict[int, tuple[str, float, Bbox]]]:
    found: dict[int, tuple[str, float, Bbox]] = {}
    draw = Text.draw

    def recording(self: Text, renderer: object) -> None:
        draw(self, renderer)
        if self.get_visible() and self.get_text().strip():
            # Of an annotation the text alone, not its arrow.
            found[id(self)] = self.get_text(), self.get_fontsize(), Text.get_window_extent(self, renderer)

    Text.draw = recording
    try:
        yield found
    finally:
        Text.draw = draw
