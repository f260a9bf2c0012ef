"""Text of a file acts on no terminal and on no spreadsheet, and what is harmless stays as it is."""

from __future__ import annotations

import unicodedata
from logging import makeLogRecord
from logging.config import DictConfigurator
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import apcc_torch
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import DataError, one_sentence
from apcc_torch.plain_text import for_spreadsheet, for_terminal, plain_logger

ACTING = "\x1b\x9b\x07\x08\r\x00\x7f\x85\u202e\u2066\u200f\u2028\ufeff\ud800"
HOSTILE = st.text(st.one_of(st.sampled_from(ACTING + "=+-@\t\n '\"1"), st.characters()), max_size=12)


@given(HOSTILE)
def test_a_terminal_gets_nothing_that_acts(text: str) -> None:
    shown = for_terminal(text)
    assert not {unicodedata.category(c) for c in shown.replace("\n", "").replace("\t", "")} & {
        "Cc",
        "Cf",
        "Cs",
        "Zl",
        "Zp",
    }
    shown.encode()
    assert for_terminal(shown) == shown


@pytest.mark.parametrize("text", ["K must be positive, got -1\n\tsee", "µ ± 0.1 °", "a\u00a0b", "日本"])
def test_what_only_shows_stays(text: str) -> None:
    assert for_terminal(text) == text


def test_an_escape_can_be_read() -> None:
    assert for_terminal("\x1b]0;title\x07\u202e") == r"\x1b]0;title\x07\u202e"


@given(HOSTILE)
def test_no_cell_begins_like_a_formula(text: str) -> None:
    cell = for_spreadsheet(text)
    assert cell in (text, f"'{text}")
    begins = "".join(c for c in cell if not c.isspace() and unicodedata.category(c) != "Cc")[:1]
    if begins in tuple("=+-@＝＋－＠") or cell[:1] in tuple("\t\r\n"):
        float(cell)


@pytest.mark.parametrize("text", ["-0.5", "+1e-3", "-inf", "[-0.1, 0.2]", "a=b", "user@host", "", "'quoted"])
def test_a_harmless_cell_stays(text: str) -> None:
    assert for_spreadsheet(text) == text


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(1)", "\t=1", "\r=1", " =1", "-", "＝1"])
def test_a_formula_becomes_text(text: str) -> None:
    assert for_spreadsheet(text) == f"'{text}"


def test_a_program_says_its_sentence_in_plain_text() -> None:
    said: list[str] = []
    with pytest.raises(SystemExit), one_sentence(said.append):
        raise DataError("body \x1b]0;owned\x07 is missing")
    assert said == [r"body \x1b]0;owned\x07 is missing"]


@pytest.mark.parametrize("name", ["simulate", "benchmark", "evaluate", "export", "identify", "realtime"])
@pytest.mark.parametrize("logging", ["job_logging", "hydra_logging"])
def test_every_line_of_a_programs_log_is_plain(name: str, logging: str) -> None:
    content = yaml.safe_load(Path(conf_path(), f"{name}.yaml").read_text(encoding="utf-8"))
    settings = content["hydra"][logging]["formatters"]["simple"]
    formatter = DictConfigurator({}).configure_formatter({"format": "[%(levelname)s] %(message)s", **settings})
    record = makeLogRecord({"levelname": "ERROR", "msg": "failed: %s\n  %s", "args": ("a\x1b[1A", "b\u202e")})
    assert formatter.format(record) == "[ERROR] failed: a\\x1b[1A\n  b\\u202e"


def test_every_module_tells_in_plain_text() -> None:
    modules = [path for path in Path(apcc_torch.__file__).parent.rglob("*.py") if path.name != "plain_text.py"]
    asking = {path.name for path in modules if "getLogger(" in path.read_text(encoding="utf-8")}
    assert asking == {"own_process.py"}, "only for its level"


def test_a_line_is_plain_whoever_formats_it(caplog: pytest.LogCaptureFixture) -> None:
    log = plain_logger("apcc_torch.told")
    assert plain_logger("apcc_torch.told") is log
    log.warning("failed: %s, %d of %s", "a\x1b[1A\u202e", 3, Path("b\r"))
    log.warning("100%s", "%")
    assert caplog.messages == ["failed: a\\x1b[1A\\u202e, 3 of b\\r", "100%"]
