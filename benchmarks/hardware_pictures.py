"""The pictures of docs/hardware.md: `python benchmarks/hardware_pictures.py` writes wiring.png and platform_arm.png."""

from __future__ import annotations

import argparse
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from apcc_torch.model.arm import Arm
from apcc_torch.report.arm_drawing import arm_figure
from apcc_torch.report.style import BLUE, EDGE, GREEN, INK, MUTED, ORANGE, VERMILION, new_figure, own_look, save_figure

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
CHAINS = "two chains that\ncarry power\nand bus;\nids in the order\nof the tendons,\n1 Mbit/s"
BOXES = {
    "supply": (0.1, 4.2, 1.9, 0.8, "12 V supply", "15 A or more"),
    "stop": (2.9, 4.2, 1.9, 0.8, "emergency stop", "latching, in the 12 V line"),
    "hub": (5.7, 4.2, 1.9, 0.8, "power hub", "feeds the motors"),
    "motors": (8.4, 2.6, 1.6, 2.4, "motors 1 to 9", CHAINS),
    "u2d2": (5.7, 2.6, 1.9, 0.8, "U2D2", "RS-485 port"),
    "pi": (2.9, 2.6, 1.9, 0.8, "Raspberry Pi 5", "apcc_torch.robot"),
    "switch": (2.9, 1.3, 1.9, 0.7, "network switch", "a subnet of their own"),
    "motive": (5.7, 1.3, 1.9, 0.7, "Motive", "streams rigid bodies"),
    "cameras": (8.4, 1.3, 1.6, 0.7, "cameras", "50 Hz or more"),
}
"""Name -> left, bottom, width, height in tenths of the figure's width; its title, and what is said of it."""
POWER, BUS, NETWORK, USB = ("12 V", VERMILION), ("RS-485", BLUE), ("network", GREEN), ("USB", ORANGE)
LINES = (
    ("supply", "stop", POWER),
    ("stop", "hub", POWER),
    ("hub", "motors", POWER),
    ("u2d2", "hub", BUS),
    ("pi", "u2d2", USB),
    ("pi", "switch", NETWORK),
    ("switch", "motive", NETWORK),
    ("motive", "cameras", NETWORK),
)
"""What joins what, and by what."""


def wiring_figure() -> Figure:
    """Supply, motors, computers and cameras, and what joins them."""
    figure = new_figure(10.0, 4.6, constrained=False)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(-0.1, 10.1), ylim=(0.5, 5.2))
    ax.axis("off")
    for a, b, (_, color) in LINES:
        _join(ax, BOXES[a][:4], BOXES[b][:4], color)
    for left, bottom, width, height, title, about in BOXES.values():
        corners = "round,pad=0,rounding_size=0.08"
        ax.add_patch(FancyBboxPatch((left, bottom), width, height, corners, fc="#f8f9fb", ec=EDGE, lw=1.2, zorder=3))
        middle, top = left + width / 2, bottom + height - 0.12
        ax.text(middle, top, title, ha="center", va="top", fontsize=12, color=INK, fontweight="bold", zorder=4)
        ax.text(middle, top - 0.3, about, ha="center", va="top", fontsize=10, color=MUTED, zorder=4, linespacing=1.3)
    for k, (name, color) in enumerate((POWER, BUS, USB, NETWORK)):
        x = 0.3 + 1.6 * k
        ax.plot((x, x + 0.4), (0.75, 0.75), color=color, linewidth=3.0)
        ax.text(x + 0.5, 0.75, name, va="center", fontsize=11, color=INK)
    return figure


def _join(ax: Axes, a: tuple[float, ...], b: tuple[float, ...], color: str) -> None:
    """A line between the facing sides of two boxes."""
    (ax0, ay0, aw, ah), (bx0, by0, _, bh) = a, b
    if ax0 + aw < bx0:
        y = max(ay0, by0) + min(ah, bh) / 2
        ax.plot((ax0 + aw, bx0), (y, y), color=color, linewidth=3.0, zorder=1)
    else:
        x = ax0 + aw / 2
        low, high = sorted(((ay0, ay0 + ah), (by0, by0 + bh)))
        ax.plot((x, x), (low[1], high[0]), color=color, linewidth=3.0, zorder=1)


def main() -> None:
    """Draws them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures (default: %(default)s)")
    out = parser.parse_args().out
    with own_look():
        save_figure(wiring_figure(), out / "wiring.png", dpi=110)
        platform = Arm.load("arm_1").changed(name="platform", layout="independent")
        save_figure(arm_figure(platform), out / "platform_arm.png", dpi=110)


if __name__ == "__main__":
    main()
