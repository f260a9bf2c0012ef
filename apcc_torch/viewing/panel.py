"""What is told beside the scene: a legend, numbers, the error over time, and what can be hidden."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from html import escape
from typing import Any

import numpy as np

from apcc_torch.report import style
from apcc_torch.viewing.moment import Array
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.scene import LAYERS, Scene

TOLD = 0.2
"""s between two readings of the numbers and the plot while time goes on."""
ROW = (
    '<tr><td style="color:{muted};padding-right:8px;white-space:nowrap">{name}</td>'
    '<td style="text-align:right">{value}</td></tr>'
)
TABLE = '<table style="width:100%;font-size:0.85em;font-variant-numeric:tabular-nums">{rows}</table>'
BOX = '<div style="padding:0.2em 1em">{content}</div>'
MARK = (
    '<span style="display:inline-block;width:0.9em;height:0.9em;border-radius:{round};background:{color};'
    'vertical-align:-0.1em;margin-right:0.5em"></span>'
)
TRUE_ARM, MODELLED_ARM = "the arm's sections", "the arm, as its controller has it"
"""What the tube may be."""


def numbers_of(target: Array, lengths: Iterable[float], tension: float | None) -> dict[str, str]:
    """What is told of an arm: target (3,) and believed rest lengths, m, and the highest tension, N, if known."""
    x, y, z = 1e3 * target
    told = {
        "target": f"{x:.0f}, {y:.0f}, {z:.0f} mm",
        "believed lengths": ", ".join(f"{1e3 * v:.0f}" for v in lengths) + " mm",
    }
    return told if tension is None else told | {"highest tension": f"{tension:.1f} N"}


class Panel:
    """The panel of a page.

    Args:
        page: Whose.
        scene: What can be hidden in it.
        sections: Of the arm.
    """

    def __init__(self, page: Page, scene: Scene, sections: int) -> None:
        self.gui = page.server.gui
        self.scene = scene
        self.sections = sections
        self.told: Any = None
        self.plot: Any = None

    def tell(self, numbers: Mapping[str, str]) -> None:
        """Shows numbers by their names, in place of the last ones."""
        rows = "".join(ROW.format(muted=style.MUTED, name=escape(n), value=escape(v)) for n, v in numbers.items())
        content = BOX.format(content=TABLE.format(rows=rows))
        if self.told is None:
            self.told = self.gui.add_html(content)
        else:
            self.told.content = content

    def draw_error(self, time: Array, error: Array, now: float | None = None) -> None:
        """The error over time, s and mm, with a mark at an instant."""
        marked = np.full_like(error, np.nan)
        if now is not None and len(time):
            k = int(np.abs(time - now).argmin())
            marked[k] = error[k]
        data = (time.astype(float), error.astype(float), marked)
        # Given, for what is not a number would be taken for the range's end.
        top = float(np.nanmax(error, initial=0.0))
        span = (float(time[0]), float(time[-1])) if len(time) > 1 else (0.0, 1.0)
        scales = {"x": {"time": False, "range": span}, "y": {"range": (0.0, max(1.08 * top, 1.0))}}
        if self.plot is not None:
            self.plot.scales, self.plot.data = scales, data
            return
        line = {"label": "error (mm)", "stroke": style.BLUE, "width": 2}
        dot = {"label": "now", "stroke": style.SENSOR, "points": {"show": True, "size": 9, "fill": style.SENSOR}}
        axes = (
            {"label": "time (s)", "labelSize": 16, "size": 32},
            {"label": "error (mm)", "labelSize": 16, "size": 44},
        )
        self.plot = self.gui.add_uplot(
            data,
            series=({"label": "time (s)"}, line, dot),
            scales=scales,
            axes=axes,
            legend={"show": False},
            height=160,
        )

    def add_layers(self, shown: tuple[str, ...] = LAYERS, arm: str = TRUE_ARM) -> None:
        """The legend, and a box to tick for each layer that is there; `arm` says what the tube is."""
        with self.gui.add_folder("What is shown", expand_by_default=True):
            self.gui.add_html(BOX.format(content=self._legend(shown, arm)))
            for layer in shown:
                box = self.gui.add_checkbox(layer, initial_value=True)
                box.on_update(self._hiding(layer))
            if "uncertainty" in shown:
                size = self.gui.add_slider(
                    "enlarged", 1.0, 100.0, 1.0, self.scene.enlarged, hint="of the ellipsoids, standard deviations"
                )
                size.on_update(lambda _: setattr(self.scene, "enlarged", float(size.value)))

    def _hiding(self, layer: str) -> Callable[[Any], None]:
        return lambda event: self.scene.hide(layer, bool(event.target.value))

    def _legend(self, shown: tuple[str, ...], arm: str) -> str:
        colors = [style.SERIES[i % len(style.SERIES)] for i in range(self.sections)]
        lines = ["".join(self._mark(color) for color in colors) + arm]
        if "model" in shown:
            lines.append(self._mark(style.INK) + "the controller's model of it")
        if "sensors" in shown:
            lines.append(self._mark(style.SENSOR) + "sensors, with their axes")
        if "uncertainty" in shown:
            lines.append(self._mark(style.PURPLE, "50%") + "where they may be, enlarged")
        if "tendons" in shown:
            ramp = f"linear-gradient(90deg,{style.EDGE},{style.VERMILION})"
            lines.append(self._mark(ramp) + "tendons, slack to tight")
        lines.append(self._mark(style.TARGET, "50%") + "target")
        return f'<div style="font-size:0.85em;line-height:1.6">{"<br>".join(lines)}</div>'

    @staticmethod
    def _mark(color: str, round_: str = "2px") -> str:
        return MARK.format(color=color, round=round_)
