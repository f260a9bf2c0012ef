"""A film has the frames it should have, is whole or absent, and falls back to GIF without ffmpeg."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.report import animation
from apcc_torch.report.animation import Stage, film_palette, frame_indices, nearest_entries, save_animation
from apcc_torch.report.backbone_drawing import Snapshots
from apcc_torch.report.space import Camera


@pytest.fixture
def no_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "imageio_ffmpeg", None)


def test_frame_indices_run_at_the_rate_asked_for() -> None:
    time = np.linspace(0.0, 10.0, 1001)
    assert frame_indices(time, 25, 1000).tolist() == list(range(0, 1001, 4))
    few = frame_indices(time, 25, 11)
    assert few.tolist() == list(range(0, 1001, 100))
    assert frame_indices(np.zeros(1), 25, 10).tolist() == [0]


def test_frame_indices_of_uneven_stamps_are_the_nearest() -> None:
    time = np.array([0.0, 0.1, 1.0, 2.0])
    assert frame_indices(time, 2, 100).tolist() == [0, 1, 2, 3, 3]  # 0, 0.5, 1, 1.5, 2 s; a tie takes the later


@pytest.mark.usefixtures("no_ffmpeg")
def test_gif_holds_every_frame(moments: Snapshots, tmp_path: Path) -> None:
    path = save_animation(tmp_path / "new" / "film", moments, {"error (mm)": torch.linspace(3, 1, 41)}, fps=5)
    assert path == tmp_path / "new" / "film.gif"
    film = Image.open(path)
    assert film.convert("RGB").getpixel((2, 448)) == (255, 255, 255)  # the background stays white
    assert film.n_frames == 21 and film.info["duration"] == 200  # 4 s at 5 a second, both ends
    assert [p.name for p in path.parent.iterdir()] == ["film.gif"]


def test_a_film_of_what_diverged_is_marked(moments: Snapshots) -> None:
    plain, marked = (Stage(moments, {}, Camera(), warning).frame(20) for warning in (None, "1 of 1 rows diverged"))
    red = [(np.abs(frame - np.array([214, 40, 57])) < 40).all(-1) for frame in (plain.astype(int), marked.astype(int))]
    assert not red[0][-30:].any() and red[1][-30:].sum() > 200, "a line below the picture"


def test_mp4_where_ffmpeg_is(moments: Snapshots, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = save_animation(tmp_path / "film", moments, fps=5)
    assert path.name == "film.mp4"
    assert ffmpeg.count_frames_and_secs(str(path))[0] == 21


@pytest.mark.usefixtures("no_ffmpeg")
def test_a_broken_film_leaves_nothing(moments: Snapshots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Stage, k: int) -> np.ndarray:
        raise RuntimeError("lost")

    monkeypatch.setattr(Stage, "frame", refuse)
    with pytest.raises(RuntimeError, match="lost"):
        save_animation(tmp_path / "film", moments)
    assert not list(tmp_path.iterdir())


def test_an_ffmpeg_that_is_not_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    class Package:
        @staticmethod
        def get_ffmpeg_exe() -> str:
            raise RuntimeError("no ffmpeg exe could be found")

    monkeypatch.setattr(animation, "imageio_ffmpeg", Package)
    assert not animation.has_ffmpeg()


def test_a_frame_shows_its_moment(moments: Snapshots) -> None:
    curve = torch.linspace(3, 1, 41)
    stage = Stage(moments, {"error (mm)": curve}, Camera())
    first, later, again = (stage.frame(k) for k in (0, 30, 0))
    assert first.shape == (450, 800, 3) and first.dtype == np.uint8
    assert (first == again).all() and (first != later).any()
    stage.frame(30)
    seen = Camera().project(moments.true_points[30].numpy())
    assert np.asarray(stage.true_line.get_xydata()) == pytest.approx(seen)
    assert np.asarray(stage.model_line.get_xydata()) == pytest.approx(
        Camera().project(moments.model_points[30].numpy())
    )
    assert np.asarray(stage.star.get_xydata())[0] == pytest.approx(Camera().project(moments.target[30].numpy()))  # type: ignore[union-attr,index]
    assert stage.heads[0].get_ydata() == pytest.approx(curve[:31].numpy())
    assert stage.clock.get_text() == "t = 3.00 s" and stage.numbers[0].get_text() == "1.50"


def test_palette_holds_the_styles_colours() -> None:
    palette = film_palette()
    assert palette.shape == (256, 3)
    nearest = nearest_entries(palette)
    for color in (animation.style.SENSOR, animation.style.TARGET, animation.style.SKY, "#ffffff"):
        r, g, b = (int(color[k : k + 2], 16) for k in (1, 3, 5))
        found = palette[nearest[(r >> 2) << 12 | (g >> 2) << 6 | b >> 2]].astype(int)
        assert abs(found - (r, g, b)).max() <= 8 and (palette == (r, g, b)).all(1).any()
    exact = ((palette[None, :].astype(int) - np.array([255, 255, 255])) ** 2).sum(-1).argmin()
    assert nearest[-1] == exact and nearest.shape == (2**18,)


def test_bad_input_is_named(moments: Snapshots, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="error"):
        save_animation(tmp_path / "film", moments, {"error (mm)": torch.zeros(3)})
    with pytest.raises(ValueRangeError, match="must be positive"):
        save_animation(tmp_path / "film", moments, fps=0)
