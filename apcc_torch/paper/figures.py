"""The figures of section V-B and Appendix A, under the paper's numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

from apcc_torch.experiments.dynamic import snapshots
from apcc_torch.paper import regret
from apcc_torch.paper.law_rows import all_lost
from apcc_torch.paper.outcomes import HELD_OUT, SINGLE, Outcome, Outcomes
from apcc_torch.report import dynamic as figures
from apcc_torch.report import style
from apcc_torch.report.animation import save_animation
from apcc_torch.report.backbone_drawing import stroboscopic_figure
from apcc_torch.report.laws import law_figure, regret_figure
from apcc_torch.report.style import warned
from apcc_torch.report.trade_off import TradeOff, trade_off_figure
from apcc_torch.simulation.divergence import sentence

MOMENTS = 6
"""Shapes in a stroboscopic figure."""


Draw = Callable[[Mapping[str, Outcome], str], Any]
"""Draws both controllers' outcomes under a title."""


def stroboscope(runs: Mapping[str, Outcome], title: str) -> Any:
    """Both controllers' shapes of one run alone."""
    shots = {name: snapshots(o.log, o.arms, 0, MOMENTS) for name, o in runs.items()}
    return warned(stroboscopic_figure(shots, title=title), _warning(runs))


def _warning(runs: Mapping[str, Outcome]) -> str | None:
    """Which controllers' rows diverged."""
    said = {name: sentence(o.curves.time, o.curves.diverged) for name, o in runs.items()}
    return "\n".join(f"{name}: {text}" for name, text in said.items() if text) or None


def drawn(figure: Callable[[figures.Runs, str], Any]) -> Draw:
    """A figure of curves as one of outcomes."""
    return lambda runs, title: warned(figure({name: o.curves for name, o in runs.items()}, title), _warning(runs))


SHAPE, PSI = drawn(figures.shape_error_figure), drawn(figures.psi_figure)
PARAMETERS, SENSORS = drawn(figures.parameter_figure), drawn(figures.sensor_figure)

NUMBERED: Mapping[int, tuple[str, Draw, str]] = {
    11: ("run_1", SHAPE, "run I"),
    12: ("run_1", PSI, "run I"),
    13: ("run_1", PARAMETERS, "run I: parameter estimates"),
    14: ("run_2_single", stroboscope, "single run of run II"),
    15: ("run_2_single", SHAPE, "single run of run II"),
    16: ("run_2_single", SENSORS, "single run of run II"),
    17: ("run_2", SHAPE, "run II"),
    18: ("run_2", PSI, "run II"),
    19: ("run_2", SENSORS, "run II"),
    40: ("robot_2", SHAPE, "arm 2"),
    41: ("robot_2_single", stroboscope, "single run of arm 2"),
    42: ("robot_2", PSI, "arm 2"),
    43: ("robot_2", SENSORS, "arm 2"),
}
"""The paper's figure -> the run it shows, how it is drawn, and its title."""


def trade_offs(outcomes: Outcomes) -> dict[str, TradeOff]:
    """Title -> trade-off of every whole grid."""
    shown: dict[str, TradeOff] = {}
    for run, both in outcomes.items():
        if run.endswith((HELD_OUT, SINGLE)):
            continue
        limits = both["standard"].limits
        fronts = {name: o.limits.trade_off() for name, o in both.items() if o.limits is not None}
        if limits is None:
            continue
        reached = {name: (o.metrics["shape_error_mean_mm"], o.metrics["psi_mean_cm"]) for name, o in both.items()}
        shown[run.replace("_", " ")] = TradeOff(fronts, 1e3 * limits.mean(limits.shape), reached)
    return shown


def save_law_figure(outcomes: Outcomes, about: Mapping[str, str], folder: Path) -> list[Path]:
    """Writes laws.png: the laws of a comparison beside each other on the held-out set-points; of many runs regret.png.

    Args:
        outcomes: Run -> row -> outcome.
        about: Row -> what it is.
        folder: Where to.
    """
    whole = {run: rows for run, rows in outcomes.items() if not run.endswith((HELD_OUT, SINGLE))}
    if len(whole) > regret.MANY:
        every: dict[str, tuple[float, float, float]] = {}
        for run, rows in whole.items():
            fixed, constant, law = (rows[row].metrics[regret.SHAPE] for row in regret.ROWS)
            every[run.replace("_", " ")] = (fixed, constant, law)
        return style.save_figures({"regret.png": lambda: regret_figure(every)}, folder)
    shown = {run: rows for run, rows in outcomes.items() if run.endswith(HELD_OUT)} or outcomes
    reached = {
        run.removesuffix(HELD_OUT).replace("_", " "): {about[name]: _reached(o) for name, o in rows.items()}
        for run, rows in shown.items()
    }
    return style.save_figures({"laws.png": lambda: law_figure(reached, "held out, ")}, folder)


def _reached(outcome: Outcome) -> tuple[float, float]:
    """Mean shape error, mm, and mean Psi, cm; NaN where all runs diverged."""
    found = outcome.metrics
    if all_lost(found):
        return nan, nan
    return found["shape_error_mean_mm"], found["psi_mean_cm"]


def save_paper_figures(outcomes: Outcomes, folder: Path) -> list[Path]:
    """Writes figure_11.png and so on for every run that there is, the trade-off, and the single run's films.

    Args:
        outcomes: Run -> controller -> outcome.
        folder: Where to.
    """
    wanted: dict[str, style.Draw] = {
        f"figure_{number}.png": partial(draw, outcomes[run], title)
        for number, (run, draw, title) in NUMBERED.items()
        if run in outcomes
    }
    chosen = trade_offs(outcomes)
    if chosen:
        wanted["trade_off.png"] = lambda: trade_off_figure(chosen)
    paths = style.save_figures(wanted, folder)
    for name, o in outcomes.get("run_2_single", {}).items():
        film = {
            "shape error (mm)": 1e3 * o.curves.shape_error[:, 0],
            "end-effector error (mm)": 1e3 * o.curves.e[:, 0],
        }
        with style.attempt(f"the film of {name}"):
            shots, warning = snapshots(o.log, o.arms, 0, None), sentence(o.curves.time, o.curves.diverged)
            paths.append(save_animation(folder / f"single_run_{name}", shots, film, warning=warning))
    return paths
