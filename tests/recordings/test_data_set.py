"""Sets of recordings: from a folder, from a server on this machine, whole or not at all, and what is said otherwise."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from apcc_torch.composition.data_file import data_override
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.recordings.data_set import DataSettings, FileSettings, located, named_set, set_names

CONTENT = {"a.csv": b"t,x\n0,1\n", "b.csv": b"t,x\n0,2\n"}


class Quiet(SimpleHTTPRequestHandler):
    """Says nothing of requests."""

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def source(tmp_path: Path) -> Iterator[str]:
    """The address of a server that has the files, the second below another name."""
    folder = tmp_path / "served"
    (folder / "deep").mkdir(parents=True)
    (folder / "a.csv").write_bytes(CONTENT["a.csv"])
    (folder / "deep" / "other.csv").write_bytes(CONTENT["b.csv"])
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("APCC_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("APCC_DATA", raising=False)
    return tmp_path / "cache"


def made(source: str, **wrong: str) -> DataSettings:
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in CONTENT.items()} | wrong
    files = {
        "a.csv": FileSettings(sha256=sums["a.csv"]),
        "b.csv": FileSettings(source="deep/other.csv", sha256=sums["b.csv"]),
    }
    return DataSettings(name="made", source=source, commit="1a2b", files=files)


def test_a_set_is_fetched_once_and_whole(source: str, cache: Path) -> None:
    pytest.importorskip("pooch")
    folder = located(made(source))
    assert folder == cache / "made-1a2b" and {p.name: p.read_bytes() for p in folder.iterdir()} == CONTENT
    assert located(made("http://127.0.0.1:9")) == folder  # nobody is asked again
    (folder / "a.csv").write_bytes(b"another")
    with pytest.raises(DataError, match=r"a\.csv: is not the file of made, its SHA-256 is another"):
        located(made(source))


def test_another_content_leaves_nothing(source: str, cache: Path) -> None:
    pytest.importorskip("pooch")
    with pytest.raises(DataError, match=r"made cannot be fetched \(SHA256 hash of downloaded file .*data_root=FOLDER"):
        located(made(source, **{"b.csv": 64 * "0"}))
    assert not list(cache.iterdir())


def test_without_a_network_one_sentence_says_what_to_fetch(cache: Path) -> None:
    pytest.importorskip("pooch")
    with pytest.raises(DataError) as told:
        located(made("http://127.0.0.1:9"))
    said = str(told.value)
    assert "http://127.0.0.1:9/a.csv, http://127.0.0.1:9/deep/other.csv, and put its files into FOLDER/made" in said
    assert "APCC_DATA" in said and "\n" not in said and not list(cache.iterdir())
    with pytest.raises(DataError, match="names no source"):
        located(DataSettings(name="own"))


def test_local_folders_come_first(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for root in ("given", "told"):
        (tmp_path / root / "made").mkdir(parents=True)
        for name, content in CONTENT.items():
            (tmp_path / root / "made" / name).write_bytes(content)
    monkeypatch.setenv("APCC_DATA", str(tmp_path / "told"))
    data = made("")
    assert located(data) == tmp_path / "told" / "made"
    assert located(data, str(tmp_path / "given")) == tmp_path / "given" / "made"
    assert located(data.changed(folder=str(tmp_path / "given" / "made"))) == tmp_path / "given" / "made"
    (tmp_path / "told" / "made" / "b.csv").unlink()
    with pytest.raises(DataError, match=r"b\.csv: cannot be read .*; made needs it"):
        located(data)
    with pytest.raises(DataError, match="data_root must hold the folder made"):
        located(data, str(tmp_path))


@pytest.mark.parametrize("name", set_names())
def test_a_declared_set_says_where_it_comes_from(name: str) -> None:
    data = named_set(name)
    assert data.name == name and data.source.startswith("https://github.com/") and data.commit in data.source
    assert data.licence and data.arm and data.learned in data.sessions
    for file in data.files.values():
        assert len(file.sha256) == 64 and int(file.sha256, 16)
    told = {session.file for session in data.sessions.values()} | {data.rest}
    assert {file for file in told if file} <= set(data.files)


def test_declared_sets_are_those_that_are_there(shared_data: Path) -> None:
    for name in set_names():
        data = named_set(name)
        assert located(data, str(shared_data)) == shared_data / (data.place or name)


def test_data_of_a_command_line(tmp_path: Path) -> None:
    assert data_override(["--help"]) == ["--help"]
    with pytest.raises(ConfigError, match=r"data must name a data set \(ftdcr, sorosim, trunk, trunk_payload\)"):
        data_override(["every=3"])
    words = data_override(["data=trunk_payload", "every=3"])
    assert words[0].startswith("data={name:'trunk_payload'") and words[1:] == [
        "split={folds:2,fold:1}",
        "arm=trunk",
        "every=3",
    ]
    assert data_override(["data=ftdcr", "arm=trunk"])[1:] == ["arm=trunk"]
    with pytest.raises(ConfigError, match="did you mean ftdcr"):
        data_override(["data=ftdc"])
    own = tmp_path / "own.csv"
    own.write_text("time,tip_x\n0,1\n")
    with pytest.raises(ConfigError, match="arm must be named"):
        data_override([f"data={own}"])
    words = data_override([f"data={own}", "arm=mine.yaml"])
    assert f"folder:'{tmp_path}'" in words[0] and "file:'own.csv'" in words[0]
    (tmp_path / "data.yaml").write_text("data: {arm: mine.yaml, sessions: {one: {file: own.csv}}}\nevery: 3\n")
    words = data_override([f"data={tmp_path}"])
    assert words[-2:] == ["every=3", f"arm={tmp_path / 'mine.yaml'}"] and f"folder:'{tmp_path}'" in words[0]
    (tmp_path / "data.yaml").write_text("sessions: {}\n")
    with pytest.raises(DataError, match="must hold the group data"):
        data_override([f"data={tmp_path / 'data.yaml'}"])
    for name in named_set("trunk_payload").files:
        (tmp_path / name).touch()
    (tmp_path / "data.yaml").unlink()
    assert data_override([f"data={tmp_path}"])[1:] == [
        "split={folds:2,fold:1}",
        f"data.folder='{tmp_path}'",
        "arm=trunk",
    ]
