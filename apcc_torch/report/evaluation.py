"""The leaderboard of an evaluation: as text, as Markdown, as figures, and as a page."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from apcc_torch.evaluation.coverage import Covered
from apcc_torch.evaluation.leaderboard import Failure, Score
from apcc_torch.evaluation.payload import Estimate
from apcc_torch.report import style
from apcc_torch.report.page.html import asset
from apcc_torch.report.pictures import stored
from apcc_torch.report.text_table import aligned, as_markdown

COLORS = {"physics": style.BLUE, "learning": style.VERMILION, "physics and learning": style.PURPLE}
PAYLOAD_TITLE = ("payload at the tip", "estimate g", "95 % from", "to", "true", "mass scale from")

COVERAGE_TITLE = (
    "95 % prediction intervals of the arm identified, from motors",
    *("body", "hold %", "least fold %", "half as wide as mm"),
)


class Board(NamedTuple):
    """One task's part of the leaderboard: its title and lines of cells, the first those of the columns."""

    title: str
    lines: list[list[str]]


class Leaderboard(NamedTuple):
    """What is shown of an evaluation.

    title: Of the data set. scores: Of methods on tasks. payloads: Estimates. failures: Methods that took no part.
    """

    title: str
    scores: Sequence[Score]
    payloads: Sequence[Estimate]
    failures: Sequence[Failure]
    coverage: Sequence[Covered] = ()

    def boards(self) -> list[Board]:
        """Every task: methods by their error, the best first, and in columns the sessions' bodies, mm."""
        found = []
        for task in dict.fromkeys(score.task for score in self.scores):
            own = [score for score in self.scores if score.task == task]
            columns = sorted({(score.body, score.session) for score in own}, key=lambda each: (each[0], each[1]))
            places = {session: k for k, session in enumerate(dict.fromkeys(score.session for score in own))}
            columns.sort(key=lambda each: (each[0], places[each[1]]))
            rows: dict[str, dict[tuple[int, str], float]] = {}
            families = {score.method: score.family for score in own}
            for score in own:
                rows.setdefault(score.method, {})[score.body, score.session] = score.mean
            order = sorted(rows, key=lambda method: sum(rows[method].values()))
            head = ["method", "family", *(f"body {body}, {session}" for body, session in columns)]
            lines = [[method, families[method], *(f"{rows[method][each]:.2f}" for each in columns)] for method in order]
            found.append(Board(f"from {task}", [head, *lines]))
        if self.payloads:
            found.append(Board(PAYLOAD_TITLE[0], [["session", *PAYLOAD_TITLE[1:]], *map(_payload_line, self.payloads)]))
        if self.coverage:
            found.append(Board(COVERAGE_TITLE[0], [list(COVERAGE_TITLE[1:]), *map(_coverage_line, self.coverage)]))
        return found

    def text(self) -> str:
        """For a terminal."""
        parts = [f"{self.title}: distance of the bodies that are asked for, root mean square, mm"]
        parts += [f"{board.title}\n{aligned(board.lines)}" for board in self.boards()]
        if self.failures:
            parts.append("\n".join(f"{failure.method} takes no part: {failure.why}" for failure in self.failures))
        return "\n\n".join(parts)

    def markdown(self) -> str:
        """For a page of the documentation."""
        return "\n\n".join(f"**{board.title}**\n\n{as_markdown(board.lines)}" for board in self.boards())

    def table(self) -> dict[str, object]:
        """For table.json, as `python -m apcc_torch.evaluate --help` says it."""
        tasks: dict[str, dict[str, dict[str, object]]] = {}
        for score in self.scores:
            entry = tasks.setdefault(score.task, {}).setdefault(
                score.method, {"family": score.family, "seconds": score.seconds, "sessions": {}}
            )
            sessions = entry["sessions"]
            assert isinstance(sessions, dict)
            value = {"rms_mm": score.mean, "folds_mm": list(score.folds)}
            sessions.setdefault(score.session, {})[f"body_{score.body}"] = value
        return {
            "data": self.title,
            "tasks": tasks,
            "payload": [estimate._asdict() for estimate in self.payloads],
            "coverage": [each._asdict() for each in self.coverage],
            "failures": {failure.method: failure.why for failure in self.failures},
        }

    def metrics(self) -> dict[str, float]:
        """Flat: "TASK, METHOD, SESSION, body B, mm"."""
        scores = {f"{s.task}, {s.method}, {s.session}, body {s.body}, mm": s.mean for s in self.scores}
        return scores | {f"95 % intervals, {c.session}, body {c.body}, %": c.mean for c in self.coverage}

    def figures(self) -> dict[str, style.Draw]:
        """File name -> what draws it, one a task."""
        tasks = dict.fromkeys(score.task for score in self.scores)
        return {
            f"task_{k + 1}.png": lambda task=task: self._bars(task)  # type: ignore[misc]
            for k, task in enumerate(tasks)
        }

    def _bars(self, task: str) -> Figure:
        """Every method's error of the last body that is asked for: a bar a session."""
        own = [score for score in self.scores if score.task == task]
        body = max(score.body for score in own)
        own = [score for score in own if score.body == body]
        sessions = list(dict.fromkeys(score.session for score in own))
        totals: dict[str, float] = {}
        for score in own:
            totals[score.method] = totals.get(score.method, 0.0) + score.mean
        order = sorted(totals, key=lambda method: totals[method])
        figure = style.new_figure(9.0, max(0.5, 0.21 * len(sessions)) * len(order) + 1.9)
        ax = figure.subplots()
        height = 0.8 / len(sessions)
        bar_type = 9.5
        for score in own:
            row = order.index(score.method) + height * (sessions.index(score.session) - 0.5 * (len(sessions) - 1))
            strength = 1.0 - 0.6 * sessions.index(score.session) / max(len(sessions) - 1, 1)
            ax.barh(row, score.mean, height, color=style.faded(COLORS[score.family], strength))
            ax.text(score.mean, row, f" {style.digits(score.mean)}", va="center", fontsize=bar_type, color=style.INK)
        ax.set_yticks(range(len(order)), order)
        ax.invert_yaxis()
        title = "\n".join(textwrap.wrap(f"{self.title}: body {body} from {task}", 60))
        if len(sessions) > 1:  # a session's bars are as pale in every method's colour
            shades = [style.faded(style.INK, 1.0 - 0.6 * k / (len(sessions) - 1)) for k in range(len(sessions))]
            keys = [Patch(color=shade, label=session) for shade, session in zip(shades, sessions, strict=True)]
            style.figure_legend(figure, keys, loc="outside lower center", ncols=min(len(keys), 3))
        style.dress(ax, "root mean square error (mm)", "", title)
        ax.grid(False, axis="y")
        ax.margins(x=0.12)
        return figure

    def page(self, folder: Path, footer: str) -> str:
        """One HTML file with the tables and the figures that lie in the folder's figures/."""
        parts = [f"<h1>{escape(self.title)}</h1>", f'<p class="hint">{escape(self.text().partition(chr(10))[0])}</p>']
        for board in self.boards():
            head, *lines = board.lines
            cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
            rows = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in line) + "</tr>" for line in lines)
            table = f"<table><thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table>"
            parts.append(
                f'<section class="card"><h2>{escape(board.title)}</h2><div class="wide">{table}</div></section>'
            )
        for failure in self.failures:
            parts.append(f"<p>{escape(f'{failure.method} takes no part: {failure.why}')}</p>")
        for picture in stored(folder):
            parts.append(f'<figure class="card"><img alt="{escape(picture.caption)}" src="{picture.uri}"></figure>')
        look = asset("style.css") + "td, th { padding: 3px 10px; text-align: left; } img { max-width: 100%; }"
        return (
            f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(self.title)}</title>\n'
            f"<style>\n{look}\n</style>\n</head>\n<body>\n<main>\n"
            + "\n".join(parts)
            + f"\n</main>\n<footer>{escape(footer)}</footer>\n</body>\n</html>\n"
        )


def _coverage_line(covered: Covered) -> list[str]:
    numbers = covered.mean, min(covered.folds), covered.half_width
    return [f"body {covered.body}, {covered.session}", *(f"{value:.1f}" for value in numbers)]


def _payload_line(estimate: Estimate) -> list[str]:
    true = "?" if estimate.true_g is None else f"{estimate.true_g:.0f}"
    numbers = (f"{value:.0f}" for value in (estimate.grams, estimate.low_g, estimate.high_g))
    return [estimate.session, *numbers, true, estimate.scale_from]
