"""docs/architecture.md and its picture name every room of the layer table, and the picture can be read."""

from __future__ import annotations

import json
from itertools import combinations, pairwise

import architecture
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from test_layers import LAYERS

DRAW = "draw it anew: python benchmarks/architecture.py"


def test_page_and_picture_name_every_room() -> None:
    rooms = [[unit or architecture.SURFACE for unit in row] for row in LAYERS]
    assert architecture.tables()[0] == rooms
    assert {room for row in rooms for room in row} == set(architecture.words())
    with Image.open(architecture.PICTURE) as picture:
        drawn = json.loads(picture.text["Source"])
    assert [[room[0] for room in row] for row in drawn] == rooms, DRAW
    assert drawn == architecture.source(), DRAW


def test_no_text_overlaps_another_or_leaves_the_picture() -> None:
    figure = architecture.draw(architecture.source())
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in figure.axes[0].texts if text.get_text()]
    width, height = figure.canvas.get_width_height()
    for words, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, words
    for (one, a), (other, b) in combinations(boxes, 2):
        assert not a.overlaps(b), f"{one!r} over {other!r}"


def test_rooms_under_one_heading_stand_together() -> None:
    headings = [heading for row in architecture.source() for _, heading, _, _ in row]
    changes = sum(one != other for one, other in pairwise(headings))
    assert changes == len(set(headings)) - 1
