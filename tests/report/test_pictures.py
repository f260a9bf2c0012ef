"""Pictures go into a page as they are, only smaller."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from apcc_torch.errors import DataError
from apcc_torch.report import pictures
from apcc_torch.report.style import new_figure, save_figure


def opened(uri: str) -> Image.Image:
    head, _, content = uri.partition(",")
    assert head == "data:image/webp;base64"
    return Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB")


@pytest.fixture
def figure() -> Figure:
    figure = new_figure(4.0, 3.0)
    figure.subplots().plot([0.0, 1.0], [0.0, 2.0])
    return figure


def test_a_figure_stays_what_it_is(tmp_path: Path, figure: Figure) -> None:
    path = save_figure(figure, tmp_path / "figure_7.png")
    shown = pictures.picture(path.name, path.read_bytes())
    original, inside = Image.open(path).convert("RGB"), opened(shown.uri)
    assert inside.size == original.size == (shown.width, shown.height) == (600, 450)
    gap = np.abs(np.asarray(inside, dtype=float) - np.asarray(original, dtype=float))
    assert gap.mean() < 1.5
    assert (shown.name, shown.film) == ("figure_7", False) and "Fig. 7" in shown.caption


def test_a_picture_too_wide_is_made_smaller() -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (3000, 600), "red").save(buffer, "PNG")
    assert opened(pictures.picture("wide.png", buffer.getvalue()).uri).size == (1500, 300)


def test_known_figures_come_first_and_in_order(tmp_path: Path, figure: Figure) -> None:
    for name in ("another_one.png", "figure_9.png", "figure_7.png"):
        save_figure(figure, tmp_path / "figures" / name)
    found = pictures.stored(tmp_path)
    assert [picture.name for picture in found] == ["figure_7", "figure_9", "another_one"]
    assert found[-1].caption == "another one"
    assert pictures.stored(tmp_path / "none") == []


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "psi.png").write_bytes(b"not a picture")
    with pytest.raises(DataError, match=r"psi\.png is no picture"):
        pictures.stored(tmp_path)


def test_the_smaller_film_is_taken(tmp_path: Path) -> None:
    assert pictures.stored_film(tmp_path) is None
    folder = tmp_path / "figures"
    folder.mkdir()
    (folder / "animation.gif").write_bytes(b"gif")
    found = pictures.stored_film(tmp_path)
    assert found is not None and found.film and found.uri == "data:image/gif;base64,Z2lm"
    (folder / "animation.mp4").write_bytes(b"mp4")
    found = pictures.stored_film(tmp_path)
    assert found is not None and found.uri == "data:video/mp4;base64,bXA0"
