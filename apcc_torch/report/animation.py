"""A film of a run: the true arm, its model, sensors and target, with errors that run along; MP4, else GIF."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.files import draft_of
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import Snapshots, check_snapshots, draw_base, space_key
from apcc_torch.report.space import WALLS, Camera, Space, bounding_box
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor

try:
    import imageio_ffmpeg
except ImportError:  # an extra; GIF needs only what matplotlib brings
    imageio_ffmpeg = None

INCHES, PIXELS_PER_INCH = (8.0, 4.5), 100


def frame_indices(time: Array, fps: float, max_frames: int) -> Array:
    """Which of the moments (T,) s to show: evenly in time, first and last included, at most `max_frames`."""
    duration = float(time[-1] - time[0])
    count = min(max_frames, int(duration * fps + 1e-9) + 1)
    wanted = np.linspace(time[0], time[-1], max(count, 1))
    after = np.searchsorted(time, wanted).clip(1, max(len(time) - 1, 1)) if len(time) > 1 else np.zeros(1, int)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - time[before] < time[after] - wanted, before, after)


class Stage:
    """The scene, drawn once; each frame redraws only what moves.

    Args:
        shots: The run; see `save_animation`.
        readouts: Label with unit -> (T,).
        camera: From where.
        warning: Stands below it.
    """

    def __init__(
        self, shots: Snapshots, readouts: Mapping[str, Tensor], camera: Camera, warning: str | None = None
    ) -> None:
        self.time = values(shots.time)
        self.true, self.model = values(shots.true_points), values(shots.model_points)
        self.markers = values(shots.true_markers)
        target = shots.target
        self.target = None if target is None else np.broadcast_to(values(target), (len(self.time), 3))
        self.readouts = {label: values(curve) for label, curve in readouts.items()}
        self.figure = style.new_figure(*INCHES, constrained=False)
        self.canvas = FigureCanvasAgg(self.figure)
        self.figure.set_dpi(PIXELS_PER_INCH)
        self.moving: list[Artist] = []
        foot = 0.0
        if warning:
            lines = textwrap.wrap(warning.replace("\n", "; "), 85)[:2]
            foot = 0.02 + 0.05 * len(lines)
            look: dict[str, Any] = {
                "va": "bottom",
                "ha": "center",
                "color": style.SENSOR,
                "fontsize": 10.0,
                "fontweight": "bold",
            }
            self.figure.text(0.5, 0.012, "\n".join(lines), **look)
        self._scene(camera, foot)
        self._curves(foot)
        for artist in self.moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def _scene(self, camera: Camera, foot: float) -> None:
        box = bounding_box(self.true, self.model, *([] if self.target is None else [self.target]))
        right = 0.6 if self.readouts else 1.0
        space = Space(self.figure.add_axes((0.0, foot, right, 0.9 - foot)), box, camera)
        draw_base(space)
        self.project = space.camera.project
        round_ends = {"solid_capstyle": "round"}
        self.trail = space.plot(self.true[:1, -1], color=style.EDGE, linewidth=1.2, zorder=1.8)
        self.true_line = space.plot(self.true[0], color=style.TRUE, linewidth=7.0, alpha=0.75, zorder=2.0, **round_ends)
        self.model_line = space.plot(self.model[0], color=style.SKY, linewidth=2.2, zorder=3.0, **round_ends)
        dots = {"linestyle": "none", "markeredgecolor": "white"}
        self.dots = space.plot(self.markers[0], marker="o", color=style.SENSOR, markersize=7.0, zorder=4.0, **dots)
        self.moving += [self.trail, self.true_line, self.model_line, self.dots]
        self.star = None
        if self.target is not None:
            self.star = space.plot(self.target[:1], marker="*", color=style.TARGET, markersize=17.0, zorder=5.0, **dots)
            self.moving.append(self.star)
        keys = space_key(markers=self.markers.shape[1] > 0, target=self.target is not None)
        keys[1].set_color(style.SKY)
        style.figure_legend(self.figure, keys, loc="upper left", bbox_to_anchor=(0.0, 1.0), fontsize=10.0)
        self.clock = self.figure.text(0.985, 0.965, "", ha="right", va="top", fontsize=12, color=style.INK)
        self.moving.append(self.clock)

    def _curves(self, foot: float) -> None:
        self.heads, self.numbers = [], []
        if not self.readouts:
            return
        grid = self.figure.add_gridspec(
            len(self.readouts), 1, left=0.68, right=0.975, bottom=0.115 + foot, top=0.86, hspace=0.5
        )
        for row, (label, curve) in enumerate(self.readouts.items()):
            ax = self.figure.add_subplot(grid[row, 0])
            style.dress(ax, "time (s)" if row == len(self.readouts) - 1 else "")
            ax.set_title(label, fontsize=10.5, color=style.INK, loc="left", pad=5)
            ax.tick_params(labelsize=9)
            ax.xaxis.label.set_fontsize(10)
            ax.plot(self.time, curve, color=style.faded(style.MODEL, 0.3), linewidth=1.3)
            style.log_scale(ax, [curve], decades=4.0)
            style.fit_time(ax, self.time)
            head = ax.plot(self.time[:1], curve[:1], color=style.MODEL, linewidth=2.0)[0]
            number = ax.text(1.0, 1.04, "", transform=ax.transAxes, ha="right", fontsize=11, color=style.MODEL)
            number.set_fontweight("bold")
            self.heads.append(head)
            self.numbers.append(number)
            self.moving += [head, number]

    def frame(self, k: int) -> Array:
        """The picture at moment k, (H, W, 3) uint8."""
        self.canvas.restore_region(self.background)
        self.trail.set_data(*self.project(self.true[: k + 1, -1]).T)
        self.true_line.set_data(*self.project(self.true[k]).T)
        self.model_line.set_data(*self.project(self.model[k]).T)
        self.dots.set_data(*self.project(self.markers[k]).T)
        if self.star is not None and self.target is not None:
            self.star.set_data(*self.project(self.target[k : k + 1]).T)
        self.clock.set_text(f"t = {self.time[k]:.2f} s")
        for head, number, curve in zip(self.heads, self.numbers, self.readouts.values(), strict=True):
            head.set_data(self.time[: k + 1], curve[: k + 1])
            number.set_text(style.digits(float(curve[k])))
        renderer = self.canvas.get_renderer()
        for artist in sorted(self.moving, key=lambda a: a.get_zorder()):
            artist.draw(renderer)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def save_animation(
    path_without_suffix: Path | str,
    shots: Snapshots,
    readouts: Mapping[str, Tensor] | None = None,
    fps: int = 25,
    max_frames: int = 250,
    warning: str | None = None,
) -> Path:
    """Writes the film of a run: .mp4 where imageio-ffmpeg has an ffmpeg, else .gif; whole or not at all.

    Args:
        path_without_suffix: Where to; the suffix is added.
        shots: The run, every moment of it (T, …); target (3,) or (T, 3).
        readouts: Label with unit -> (T,) curves that run along, two or so.
        fps: Frames a second of film.
        max_frames: Most frames; a run too long for them is shown faster.
        warning: Stands below it: that what it shows diverged.

    Returns:
        The file's path.

    Raises:
        ShapeError, DtypeError: A field does not fit the others.
        ValueRangeError: fps or max_frames is not positive.
    """
    check_snapshots("shots", shots)
    readouts = {} if readouts is None else readouts
    for label, curve in readouts.items():
        check_tensor(label, curve[None], (1, len(shots.time)))
    if not (fps > 0 and max_frames > 0):
        raise ValueRangeError(f"fps and max_frames must be positive, got {fps} and {max_frames}")
    # An absolute path: ffmpeg takes what stands before a colon for a protocol.
    base = Path(path_without_suffix).absolute()
    film = has_ffmpeg()
    target = base.with_name(base.name + (".mp4" if film else ".gif"))
    with style.own_look(), draft_of(target) as draft:
        stage = Stage(shots, readouts, Camera(), warning)
        indices = frame_indices(stage.time, fps, max_frames)
        pictures = (stage.frame(int(k)) for k in indices)
        if film:
            _write_mp4(draft, pictures, fps)
        else:
            _write_gif(draft, pictures, fps)
    return target


def has_ffmpeg() -> bool:
    """Whether imageio-ffmpeg is there and knows an executable."""
    if imageio_ffmpeg is None:
        return False
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        return False
    return True


def _write_mp4(path: Path, pictures: Iterator[Array], fps: int) -> None:
    first = next(pictures)
    size = (first.shape[1], first.shape[0])
    look = {"codec": "libx264", "quality": 7, "macro_block_size": 2}
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, ffmpeg_log_level="error", **look)
    writer.send(None)
    try:
        for picture in chain((first,), pictures):
            writer.send(np.ascontiguousarray(picture))
    finally:
        writer.close()


def _write_gif(path: Path, pictures: Iterator[Array], fps: int) -> None:
    palette = film_palette()
    nearest = nearest_entries(palette)

    def indexed(picture: Array) -> Image.Image:
        r, g, b = np.moveaxis(picture.astype(np.int64) >> 2, -1, 0)
        image = Image.fromarray(nearest[r << 12 | g << 6 | b])
        image.putpalette(palette.tobytes())
        return image

    frames = (indexed(picture) for picture in pictures)
    first = next(frames)
    first.save(path, save_all=True, append_images=frames, duration=round(100 / fps) * 10, loop=0, optimize=False)


def film_palette() -> Array:
    """256 colours (256, 3) uint8: the style's own, towards white. One for all frames, so that nothing flickers."""
    main = (style.INK, style.MUTED, style.TRUE, style.MODEL, style.SKY, style.SENSOR, style.TARGET)
    colors = [style.faded(color, strength) for color in main for strength in np.linspace(1.0, 0.1, 34)]
    colors += [style.faded(color, 1.0) for color in ("white", style.EDGE, style.GRID, *WALLS)]
    colors += [colors[0]] * (256 - len(colors))
    return np.round(255.0 * np.array(colors)).astype(np.uint8)


def nearest_entries(palette: Array) -> Array:
    """The nearest palette entry of every colour of 6 bits a channel, (2^18,) uint8.

    Pillow's own search is coarser: it takes white for a wall.
    """
    level = np.arange(64)
    level = level << 2 | level >> 4
    cube = np.stack(np.meshgrid(level, level, level, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    entries = palette.astype(np.float32)
    offset = (entries**2).sum(-1)
    return np.concatenate([(offset - 2.0 * part @ entries.T).argmin(-1) for part in np.split(cube, 64)]).astype(
        np.uint8
    )
