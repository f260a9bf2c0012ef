"""The one look of every figure: colours, sizes, axes and files. No figure touches matplotlib's global state."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colors, rc_context, rcParamsDefault
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import in_a_line
from apcc_torch.files import write_atomically
from apcc_torch.plain_text import plain_logger

Array = NDArray[Any]

# Okabe and Ito's palette, told apart under every common colour blindness; identities keep one colour in all figures.
BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"
INK, MUTED, EDGE, GRID = "#1f2933", "#5b6670", "#9aa5b1", "#e4e7eb"
TRUE, MODEL, SENSOR, TARGET = "#3e4c59", BLUE, "#d62839", GREEN
CONTROLLERS = {"standard": VERMILION, "adaptive": BLUE}
SERIES = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.2, 1.4)), (0, (6, 2, 1.2, 2)))

TITLE, LABEL, TICK, LEGEND = 13.0, 12.0, 11.0, 11.0
LINE = 2.0
WIDEST = 10.0
"""Inches of the widest figure: what is wider is scaled down on a page until its type is too small."""
DPI = 150
WARNING: Mapping[str, Any] = {"fontsize": LABEL, "color": SENSOR, "fontweight": "bold"}
LOOK = {key: value for key, value in rcParamsDefault.items() if not key.startswith(("backend", "interactive"))}
"""matplotlib's own settings, on which the rest of the look builds."""

Draw = Callable[[], Figure]
"""Draws a figure when it is called."""

log = plain_logger(__name__)
_tell: ContextVar[Callable[[str], object]] = ContextVar("tell", default=log.warning)


def values(tensor: Tensor) -> Array:
    """The tensor's numbers as a numpy array on the CPU."""
    return tensor.detach().cpu().numpy()


def new_figure(width: float = 10.0, height: float = 6.0, constrained: bool = True) -> Figure:
    """An empty white figure of width x height inches; `constrained` lets matplotlib place the axes."""
    return Figure(figsize=(width, height), facecolor="white", layout="constrained" if constrained else None)


def dress(ax: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Labels with units, a light grid behind the data, and two spines instead of four."""
    ax.set_xlabel(x, fontsize=LABEL, color=INK)
    ax.set_ylabel(y, fontsize=LABEL, color=INK)
    if title:
        ax.set_title(title, fontsize=TITLE, color=INK, loc="left", pad=8)
    ax.tick_params(labelsize=TICK, colors=MUTED, length=3)
    ax.grid(True, color=GRID, linewidth=0.9)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(EDGE)


def legend(ax: Axes, **options: Any) -> None:
    """A legend in the common look, where the axes hold labelled artists."""
    if not ax.get_legend_handles_labels()[1]:
        return
    look: dict[str, Any] = {"fontsize": LEGEND, "labelcolor": INK, "frameon": True, "framealpha": 0.9}
    look |= {"edgecolor": "none", "facecolor": "white", "handlelength": 2.2, "borderaxespad": 0.3}
    ax.legend(**(look | options))


def figure_legend(figure: Figure, entries: Axes | Sequence[Artist], **options: Any) -> None:
    """A legend of the whole figure, in one row unless `ncols` is given: of an axes' labelled artists, or of these."""
    handles = entries.get_legend_handles_labels()[0] if isinstance(entries, Axes) else entries
    look: dict[str, Any] = {"fontsize": LEGEND, "labelcolor": INK, "frameon": False, "ncols": len(handles)}
    figure.legend(handles=handles, **(look | options))


def fit_time(ax: Axes, time: Array) -> None:
    """Time limits that touch the data."""
    if len(time) > 1 and time[-1] > time[0]:
        ax.set_xlim(float(time[0]), float(time[-1]))


def log_scale(ax: Axes, data: Sequence[Array], decades: float = 5.0) -> None:
    """A logarithmic y axis over at most so many decades below the largest value; linear where nothing is positive."""
    flat = np.concatenate([np.ravel(d) for d in data])
    positive = flat[np.isfinite(flat) & (flat > 0)]
    if not positive.size:
        return
    top = float(positive.max())
    bottom = max(float(np.quantile(positive, 0.005)), top * 10.0**-decades)
    ax.set_yscale("log", nonpositive="mask")
    low, high = float(10.0 ** np.floor(np.log10(bottom))), 1.6 * top
    if high / low < 150:  # so that at least two decades are numbered
        high = max(high, float(10.0 ** np.ceil(np.log10(top))))
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(LogLocator(10, numticks=6))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: decade(v)))
    ax.yaxis.set_minor_formatter(NullFormatter())


def decade(value: float) -> str:
    """A number of a logarithmic axis: 0.01, 1, 1000; a small or large power of ten as a formula."""
    return f"{value:g}" if 1e-3 <= value < 1e4 else rf"$10^{{{round(np.log10(value))}}}$" if value > 0 else ""


def from_zero(ax: Axes) -> None:
    """A linear y axis that starts at zero."""
    top = ax.get_ylim()[1]
    if top > 0:
        ax.set_ylim(0.0, 1.08 * top)


def faded(color: str, strength: float) -> tuple[float, float, float]:
    """The colour mixed with white: strength 1 is the colour, 0 white."""
    return tuple(1.0 - strength * (1.0 - c) for c in colors.to_rgb(color))  # type: ignore[return-value]


def digits(value: float) -> str:
    """A number with three significant digits, trailing zeros kept: 1.30, 0.0412, 123; 4.12 10^-6 as a formula."""
    text = f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")
    head, exponent, power = text.partition("e")
    return rf"${head.rstrip('.')}\cdot 10^{{{int(power)}}}$" if exponent else text


class Unit(NamedTuple):
    """A unit to draw in: its name, and how many of it are in the SI unit."""

    name: str
    per_si: float


LENGTHS = (Unit("m", 1.0), Unit("cm", 1e2), Unit("mm", 1e3), Unit("\N{MICRO SIGN}m", 1e6), Unit("nm", 1e9))
ANGLES = (Unit("rad", 1.0), Unit("crad", 1e2), Unit("mrad", 1e3), Unit("\N{MICRO SIGN}rad", 1e6), Unit("nrad", 1e9))


def fitting(units: Sequence[Unit], data: Sequence[Array], wanted: str) -> Unit:
    """The unit in which data's largest number is well told: the wanted one, or the first smaller one that shows it.

    Args:
        units: From the largest to the smallest.
        data: In the SI unit.
        wanted: The name of the one that is taken where its numbers are not small.
    """
    flat = np.concatenate([np.abs(np.ravel(d)) for d in data])
    flat = flat[np.isfinite(flat)]
    top = float(flat.max()) if flat.size else 0.0
    smaller = units[[unit.name for unit in units].index(wanted) :]
    return next((unit for unit in smaller if top * unit.per_si >= 0.1), smaller[0] if top == 0.0 else smaller[-1])


def controller_color(name: str, index: int) -> str:
    """The controller's colour in all figures; by position for a name the toolkit does not know."""
    return CONTROLLERS.get(name, SERIES[index % len(SERIES)])


@contextmanager
def own_look() -> Iterator[None]:
    """Figures made and saved within have the one look, whatever a user's matplotlibrc asks for."""
    with rc_context(LOOK):
        yield


@contextmanager
def failures_told(tell: Callable[[str], object]) -> Iterator[None]:
    """Within, a figure that cannot be drawn is told to `tell`; else it is a warning in the log."""
    token = _tell.set(tell)
    try:
        yield
    finally:
        _tell.reset(token)


@contextmanager
def attempt(name: str) -> Iterator[None]:
    """Draws in the own look; a failure is told in one sentence, and what comes after goes on."""
    try:
        with own_look():
            yield
    except Exception as error:  # of one figure, whatever it is: what a run has computed is worth more
        _tell.get()(f"{name} is not drawn: {in_a_line(error)}")


def save_figure(figure: Figure, path: Path | str, dpi: float = DPI) -> Path:
    """Writes the figure in the format of the path's suffix, so that a reader never meets half a file.

    Args:
        figure: The figure.
        path: Where to; the folder is made if it is not there.
        dpi: Pixels an inch.

    Returns:
        The path.
    """
    target = Path(path)
    buffer = io.BytesIO()
    with own_look():
        figure.savefig(buffer, format=target.suffix.lstrip(".") or "png", dpi=dpi)
    return write_atomically(target, buffer.getvalue())


def save_figures(
    figures: Mapping[str, Draw], folder: Path | str, dpi: float = DPI, warning: str | None = None
) -> list[Path]:
    """Draws and writes a set into one folder; a figure that fails is told, and the others go on.

    Args:
        figures: File name -> what draws the figure.
        folder: Where to; made if it is not there.
        dpi: Pixels an inch.
        warning: Stands below each of them.

    Returns:
        The files that are there.
    """
    paths = []
    for name, draw in figures.items():
        with attempt(name):
            paths.append(save_figure(warned(draw(), warning), Path(folder) / name, dpi))
    return paths


def warned(figure: Figure, warning: str | None) -> Figure:
    """The figure with a strip below it that holds a warning: that what it shows diverged."""
    if not warning:
        return figure
    width, height = figure.get_size_inches()
    lines = [part for line in warning.splitlines() for part in textwrap.wrap(line, int(9.5 * width))]
    strip = 0.14 + 0.22 * len(lines)
    whole = height + strip
    figure.text(0.5, 0.07 / whole, "\n".join(lines), ha="center", va="bottom", **WARNING)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(rect=(0.0, strip / whole, 1.0, height / whole))  # type: ignore[call-arg]
        figure.set_size_inches(width, whole)
        return figure
    anchors = [each.get_bbox_to_anchor().transformed(figure.transFigure.inverted()) for each in figure.legends]
    figure.set_size_inches(width, whole)

    def up(y: float) -> float:
        return (y * height + strip) / whole

    for ax in figure.axes:
        place = ax.get_position(original=True)
        ax.set_position((place.x0, up(place.y0), place.width, place.height * height / whole))
    for text in figure.texts[:-1]:
        text.set_y(up(text.get_position()[1]))
    for each, anchor in zip(figure.legends, anchors, strict=True):
        each.set_bbox_to_anchor((anchor.x0, up(anchor.y0), anchor.width, anchor.height * height / whole))
    return figure
