"""The page holds its data, and nothing in it reaches for a network."""

from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import apcc_torch.report.page
from apcc_torch.report.page.html import SCRIPTS, Page, inside_script
from apcc_torch.report.pictures import Picture
from apcc_torch.report.run_record import Run
from apcc_torch.report.run_table import tidy

ASSETS = Path(apcc_torch.report.page.__file__).parent / "assets"
HOSTILE = "</script><script>alert(1)</script>"


class Reader(HTMLParser):
    """Collects the tags with their attributes, and the text of the data."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inside = False
        self.data = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.inside = dict(attrs).get("id") == "data"

    def handle_endtag(self, tag: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.data += data


def page(title: str = "a title") -> Page:
    runs = [
        Run("0", "complete", {"a.gain": 0.1}, metrics={"e_mm": 1 / 3, "f": math.nan, "wall_s": 4.0}),
        Run("1", "complete", {"a.gain": 0.2}, metrics={"e_mm": math.inf, "f": -math.inf, "wall_s": 4.5}),
        Run(HOSTILE, "failed", {"a.gain": 0.3}, note="why"),
    ]
    pictures = {1: [Picture("figure_7", "Fig. 7", "data:image/webp;base64,AAAA", False, 4, 3)]}
    return Page(title, tidy(runs), "e_mm", True, pictures, [0, 1], "Computed with x 1.")


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    return reader


def test_the_data_is_the_table() -> None:
    data = json.loads(read(page().html()).data)
    columns = {column["name"]: column for column in data["columns"]}
    assert columns["run"]["cells"] == ["0", "1", HOSTILE] and columns["a.gain"]["cells"] == [0.1, 0.2, 0.3]
    # Seven digits of a metric, what is not finite as JavaScript writes it, and nothing where there is no number.
    assert columns["e_mm"]["cells"] == [0.3333333, "Infinity", None]
    assert columns["f"]["cells"] == ["NaN", "-Infinity", None] and columns["wall_s"]["cells"] == [4, 4.5, None]
    assert (columns["e_mm"]["words"], columns["e_mm"]["unit"], columns["e_mm"]["kind"]) == ("e", "mm", "metric")
    assert data["metric"] == "e_mm" and data["descending"] is True and data["folders"] == [0, 1]
    assert data["pictures"]["1"][0]["uri"] == "data:image/webp;base64,AAAA"


def test_no_text_of_a_run_becomes_part_of_the_page() -> None:
    reader = read(page(f"{HOSTILE} & more").html())
    assert [tag for tag, _ in reader.tags].count("script") == 2
    assert json.loads(inside_script({"a": HOSTILE})) == {"a": HOSTILE} and "<" not in inside_script({"a": HOSTILE})


def test_nothing_is_fetched() -> None:
    html = page().html()
    reader = read(html)
    for tag, attributes in reader.tags:
        for name in ("src", "href", "action", "poster"):
            value = attributes.get(name)
            assert not value or value.startswith(("#", "data:")), f"<{tag} {name}={value}>"
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|\bimport\b ", html)
    (policy,) = [a["content"] for _, a in reader.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy is not None and "default-src 'none'" in policy


def test_every_script_is_there_once_and_every_id_it_asks_for_is_in_the_page() -> None:
    html = page().html()
    ids = [attributes["id"] for _, attributes in read(html).tags if attributes.get("id")]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'byId\("([\w-]+)"\)', html)) <= set(ids)
    assert len(SCRIPTS) == len(set(SCRIPTS)) == len(list(ASSETS.glob("*.js")))
