"""The page in a real browser: it opens without errors, sorts, filters, redraws, and shows the runs that are chosen."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from apcc_torch.report import __main__ as program
from chromium import started

WriteRun = Callable[..., Path]
POINTS = 10_000


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    browser = started(tmp_path_factory.mktemp("browser"), "--disable-gpu")
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def few(real_runs: Path, tmp_path_factory: pytest.TempPathFactory, write_run: WriteRun) -> Path:
    """The page of two real runs with figures, one of them with a film, and of one that failed."""
    root = shutil.copytree(real_runs / "kinematic", tmp_path_factory.mktemp("few") / "sweep")
    write_run(root / "2", {"adaptation": {"gain_scale": 7.0}})
    (root / "2" / "simulate.log").write_text("[t][x][ERROR] - the gain is <b>too</b> high\n")
    program.main([str(root), "--films", "1"])
    return root / "report.html"


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory, write_run: WriteRun) -> Path:
    """The page of 10,000 points: an error that is least at gain 1, and one number that is none."""
    root = write_run(tmp_path_factory.mktemp("many") / "batch", {"a": {"gain": 1.0, "window": 5}}, {"wall_s": 1.0})
    with (root / "points.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["point", "a.gain", "a.window", "shape_error_mean_mm", "psi_mean_cm"])
        for k in range(POINTS):
            gain, window = 10 ** (k // 100 / 25 - 2), 5 + 2 * (k % 100)
            error = math.nan if k == 17 else 1 + abs(math.log10(gain)) + window / 1000
            writer.writerow([k, gain, window, error, 3 + gain])
    program.main([str(root)])
    return root / "report.html"


def opened(browser: Any, page: Path) -> Any:
    browser.get(page.as_uri())
    return browser


def run(browser: Any, script: str) -> Any:
    return browser.execute_script(script)


def errors(browser: Any) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser")]


def column(browser: Any, name: str) -> list[str]:
    """The texts of a column's rows in sight."""
    place = run(
        browser,
        f"return [...document.querySelectorAll('#scroll thead tr:first-child th')].findIndex("
        f"(head) => head.dataset.column === {json.dumps(name)})",
    )
    assert place >= 0
    script = (
        f"return [...document.querySelectorAll('#scroll tbody tr[data-row]')].map((r) => r.children[{place}].innerText)"
    )
    found: list[str] = run(browser, script)
    return found


def click(browser: Any, selector: str) -> None:
    run(browser, f"document.querySelector({json.dumps(selector)}).click()")


def write(browser: Any, selector: str, text: str) -> None:
    run(
        browser,
        f"const e = document.querySelector({json.dumps(selector)}); e.value = {json.dumps(text)};"
        "e.dispatchEvent(new Event(e.tagName === 'SELECT' ? 'change' : 'input', {bubbles: true}))",
    )


def shown(browser: Any) -> str:
    text: str = run(browser, "return document.getElementById('shown').textContent")
    return text


def painted(browser: Any) -> list[str]:
    """What the canvases of the plots hold."""
    found: list[str] = run(
        browser, "return [...document.querySelectorAll('.panel > canvas')].map((c) => c.toDataURL())"
    )
    return found


def scrolled(browser: Any, to: str) -> None:
    """Scrolls the table and waits until its rows are drawn anew."""
    run(browser, f"const scroller = document.getElementById('scroll'); scroller.scrollTop = {to}")
    run(browser, "return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def test_it_opens_with_every_part_and_no_error(browser: Any, few: Path) -> None:
    opened(browser, few)
    assert errors(browser) == []
    assert run(browser, "return document.getElementById('counts').textContent") == "3 runs: 2 complete, 1 failed"
    assert column(browser, "run") == ["0", "1", "2"] and column(browser, "status") == ["complete", "complete", "failed"]
    assert "adaptation.gain_scale" in run(browser, "return document.getElementById('swept').innerText")
    assert "torch" in run(browser, "return document.getElementById('versions').textContent")
    # What a run wrote stays text.
    assert "the gain is <b>too</b> high" in column(browser, "note")[2]
    assert run(browser, "return document.documentElement.scrollWidth <= innerWidth")


def test_a_click_on_a_heading_sorts_and_another_turns_it_round(browser: Any, many: Path) -> None:
    opened(browser, many)
    head = "[data-column='shape_error_mean_mm'] button"
    click(browser, head)
    up = [float(text) for text in column(browser, "shape_error_mean_mm")]
    assert up == sorted(up) and up[0] == pytest.approx(1.005)
    assert (
        run(browser, "return document.querySelector('[aria-sort=ascending]').dataset.column") == "shape_error_mean_mm"
    )
    click(browser, head)
    down = [float(text) for text in column(browser, "shape_error_mean_mm")]
    assert down == sorted(down, reverse=True) and down[0] == pytest.approx(3.203)
    # What is no number is last either way.
    scrolled(browser, "scroller.scrollHeight")
    assert column(browser, "shape_error_mean_mm")[-1] == "NaN" and column(browser, "run")[-1] == "points/17"
    assert errors(browser) == []


@pytest.mark.parametrize(
    ("name", "expression", "count"),
    [
        ("a.window", "<15", 500),
        ("a.window", ">= 201", 200),
        ("a.window", "15..19", 300),
        ("a.window", ">5 <=9", 200),
        ("a.window", "!=5", 9900),
        ("a.window", "5", 100),
        ("a.gain", "=0.01", 100),
        ("shape_error_mean_mm", ">0", 9999),
        ("run", "points/99", 111),
        ("run", "=points/99", 1),
        ("run", "!9", 6561),
    ],
)
def test_a_column_is_filtered_by_an_expression(
    browser: Any, many: Path, name: str, expression: str, count: int
) -> None:
    if browser.current_url != many.as_uri():  # each leaves it as it was
        opened(browser, many)
    before = painted(browser)
    write(browser, f"[data-filter='{name}']", expression)
    assert shown(browser) == f"{count:,} of 10,000 runs pass the filters"
    assert run(browser, "return document.querySelector('#scroll table').ariaRowCount") == str(count + 1)
    # The one point that is no number is drawn in neither.
    assert (painted(browser) == before) == (count == POINTS - 1)
    click(browser, "#clear")
    assert shown(browser) == "10,000 runs" and painted(browser) == before
    assert errors(browser) == []


def test_filters_add_up_and_one_that_cannot_be_read_says_so(browser: Any, many: Path) -> None:
    opened(browser, many)
    write(browser, "[data-filter='a.window']", "<15")
    write(browser, "#find", "points/1")
    texts = column(browser, "run")
    assert shown(browser).startswith("56 of") and all(text.startswith("points/1") for text in texts)
    write(browser, "[data-filter='a.window']", "<fifteen")
    field = "document.querySelector(\"[data-filter='a.window']\")"
    assert run(browser, f"return {field}.ariaInvalid") == "true" and "Not understood" in run(
        browser, f"return {field}.title"
    )
    assert shown(browser).startswith("1,111 of")
    write(browser, "#find", "nothing like it")
    assert "No run passes the filters." in run(browser, "return document.querySelector('#scroll tbody').innerText")
    assert errors(browser) == []


def test_ten_thousand_rows_are_not_ten_thousand_elements(browser: Any, many: Path) -> None:
    opened(browser, many)
    count = "return document.querySelectorAll('#scroll tbody tr[data-row]').length"
    assert 10 < run(browser, count) < 80
    scrolled(browser, "33 * 5000")
    assert "points/5000" in column(browser, "run") and 10 < run(browser, count) < 80
    assert many.stat().st_size < 3_000_000


def test_another_metric_redraws_the_plots_and_the_pair(browser: Any, many: Path) -> None:
    opened(browser, many)
    before = painted(browser)
    assert len(before) == 2
    pair = "return [...document.querySelectorAll('#pair thead button')].map((b) => b.textContent)"
    # By hand: gain 1 is at k // 100 == 50, and the smallest window is the first there; the worst is gain 10^1.96.
    assert run(browser, pair) == ["points/5000", "points/99"]
    write(browser, "#metric", "psi_mean_cm")
    assert all(new != old for new, old in zip(painted(browser), before, strict=True))
    assert run(browser, pair) == ["points/0", "points/9999"]
    assert "psi mean" in run(browser, "return document.querySelector('.panel figcaption').textContent")
    write(browser, "#order", "down")
    assert run(browser, pair)[1] == "points/99" and run(browser, pair)[0] == "points/9900"
    again = painted(browser)
    write(browser, "#scale", "linear")
    assert painted(browser) != again
    write(browser, "#colour", "none")
    assert run(browser, "return document.querySelector('.legend').textContent") == ""
    assert errors(browser) == []


def test_a_chosen_run_shows_its_numbers_its_figures_and_its_film(browser: Any, few: Path) -> None:
    opened(browser, few)
    figures = "return [...document.querySelectorAll('#detail [data-figure]')].map((f) => f.dataset.figure)"
    # The better run comes first, and with the film.
    (best, worst) = run(
        browser, "return [...document.querySelectorAll('#pair thead button')].map((b) => b.textContent)"
    )
    assert run(browser, "return document.querySelector('#detail h3').textContent") == best
    assert run(browser, figures) == ["figure_7", "figure_8", "figure_9", "animation"]
    click(browser, f"#scroll [data-run='{worst}']")
    assert run(browser, "return document.querySelector('#detail h3').textContent") == worst
    assert run(browser, figures) == ["figure_7", "figure_8", "figure_9"]
    loaded = """const images = [...document.images].filter((image) => image.src);
        return Promise.all(images.map((image) => image.decode().then(() => image.naturalWidth)));"""
    assert all(width > 500 for width in run(browser, loaded))
    metrics = json.loads((few.parent / worst / "metrics.json").read_text())
    told = run(browser, "return document.querySelector('#detail').innerText")
    assert f"{metrics['psi_mean_cm']:.3f}"[:4] in told and "adaptation.gain_scale" in told
    write(browser, "#pick", "2")
    told = run(browser, "return document.querySelector('#detail').innerText")
    assert "failed: the gain is <b>too</b> high" in told and "No figures" in told
    click(browser, "#next")
    assert run(browser, "return document.querySelector('#detail h3').textContent") == "0"
    assert errors(browser) == []


def test_the_film_can_be_played(browser: Any, few: Path) -> None:
    opened(browser, few)
    wait = """const film = document.querySelector('#detail video'), done = arguments[0];
        if (!film) return done(document.querySelector('#detail [data-figure=animation] img') ? 'gif' : 'none');
        const ready = () => film.readyState >= 1 && film.duration > 0;
        const look = () => ready() ? done(film.videoWidth) : setTimeout(look, 50);
        look();"""
    assert browser.execute_async_script(wait) in (800, "gif")


def test_best_and_worst_stand_side_by_side_in_any_figure(browser: Any, few: Path) -> None:
    opened(browser, few)
    sides = "return [...document.querySelectorAll('#pair-figures [data-figure]')].map((f) => f.dataset.figure)"
    assert run(browser, sides) == ["figure_7", "figure_7"]
    write(browser, "#figure", "figure_9")
    assert run(browser, sides) == ["figure_9", "figure_9"]
    boxes = run(
        browser,
        "return [...document.querySelectorAll('#pair-figures figure')].map((f) => f.getBoundingClientRect().left)",
    )
    assert boxes[1] > boxes[0] + 300
    click(browser, "#pair-figures button")
    assert run(browser, "return document.getElementById('large').open")
    assert errors(browser) == []


def test_the_keyboard_reaches_points_and_rows(browser: Any, few: Path) -> None:
    opened(browser, few)
    press = """document.querySelector('.panel > canvas').dispatchEvent(
        new KeyboardEvent('keydown', {key: '%s', bubbles: true, cancelable: true}))"""
    told = "return document.querySelector('.tip').hidden ? '' : document.querySelector('.tip b').textContent"
    run(browser, press % "ArrowRight")
    assert run(browser, told) == "0"
    run(browser, press % "ArrowRight")
    assert run(browser, told) == "1"
    run(browser, press % "Enter")
    assert run(browser, "return document.querySelector('#detail h3').textContent") == "1"
    names = """const pictured = (e) => e.textContent.trim() || e.querySelector('img[alt]');
        const named = (e) => e.labels?.length || e.ariaLabel || pictured(e);
        const all = [...document.querySelectorAll('input, select, button')].filter((e) => e.checkVisibility());
        return all.length > 20 && all.filter((e) => !named(e)).length;"""
    assert run(browser, names) == 0, "every control has a name"


def test_the_theme_changes_and_a_phone_holds_the_page(browser: Any, few: Path) -> None:
    opened(browser, few)
    colour = "return getComputedStyle(document.body).backgroundColor"
    themes = {}
    for _ in range(3):
        click(browser, "#theme")
        themes[run(browser, "return document.getElementById('theme').textContent")] = run(browser, colour)
    assert themes["Theme: light"] != themes["Theme: dark"]
    view = {"width": 390, "height": 800, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", view)
    try:
        opened(browser, few)
        assert run(browser, "return document.documentElement.scrollWidth") <= 390
        assert errors(browser) == []
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
