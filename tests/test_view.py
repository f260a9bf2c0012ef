"""`view`: what it is told to show is there or refused in a sentence, and Ctrl-C ends it."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections import defaultdict
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from apcc_torch import view
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.recorded_run import recorded
from apcc_torch.viewing.page import Page
from apcc_torch.web_address import WebAddress
from commands import QUICK, simulate


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("view")
    done = simulate(folder, *QUICK, "hydra.run.dir=run", "compile=off")
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.fixture
def taken() -> socket.socket:
    """A port that somebody listens on."""
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    return listening


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        view.main(words)
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1, said
    return said


def test_a_run_is_served_until_ctrl_c(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    told, pages, tell = threading.Event(), [], view.tell

    def look(page: Page, what: str) -> None:
        tell(page, what)
        told.set()

    def stop() -> None:
        told.wait(60.0)
        with urlopen(address.url, timeout=30.0) as page:
            pages.append(page.read().lower())
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(view, "tell", look)
    address = WebAddress(port=0).free()
    threading.Thread(target=stop).start()
    with pytest.raises(SystemExit) as ended:
        view.main([str(run), "--port", str(address.port)])
    said = capsys.readouterr()
    assert ended.value.code == 130 and b"<html" in pages[0]
    assert f"{address.url}: play, or move the time" in said.out and "stopped by Ctrl-C" in said.err
    assert address.free() == address, "the port is given back"


def test_a_run_becomes_a_file_for_foxglove(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    reader = pytest.importorskip("mcap.reader")
    decoders = [pytest.importorskip(f"mcap_{kind}.decoder").DecoderFactory() for kind in ("protobuf", "ros2")]
    file = tmp_path / "run.mcap"
    view.main([str(run), "--foxglove", str(file)])
    assert capsys.readouterr().out == f"{file}\n"
    shown, found = recorded(run), defaultdict(list)
    with file.open("rb") as stream:
        for _, channel, message, content in reader.make_reader(
            stream, decoder_factories=decoders
        ).iter_decoded_messages():
            found[channel.topic].append((message.log_time, content))
    assert set(found) == {"/tf", "/sensors", "/tip", "/target", "/arm", "/run"}
    assert [stamp for stamp, _ in found["/run"]] == [round(1e9 * time) for time in shown.time.tolist()]
    for k, (_, numbers) in enumerate(found["/run"]):
        assert np.linalg.norm(np.subtract(numbers.target, numbers.tip)) == pytest.approx(
            float(shown.error[k, 0]), abs=1e-9
        )
        assert np.allclose(numbers.tip, shown.moment(k, 0).tip, atol=1e-12)
        sensors = shown.moment(k, 0).sensors
        assert sensors is not None
        told = [[p.position.x, p.position.y, p.position.z] for p in found["/sensors"][k][1].poses]
        assert np.allclose(told, sensors[:, :3, 3], atol=1e-12)
    assert "--foxglove is of a run, and arm_1 is an arm" in refused(capsys, "arm_1", "--foxglove", str(file))
    assert "row must be 0 to 0, got 3" in refused(capsys, str(run), "--row", "3", "--foxglove", str(file))


def test_what_cannot_be_shown_is_refused_in_a_sentence(
    run: Path, taken: socket.socket, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = str(taken.getsockname()[1])
    assert f"--port={port} of 127.0.0.1 cannot be had" in refused(capsys, str(run), "--port", port)
    assert "--host=nowhere.invalid is no address" in refused(capsys, str(run), "--host", "nowhere.invalid")
    assert "port must be " in refused(capsys, str(run), "--port", "70000")
    assert "--row must be 0 to 0, got 3" in refused(capsys, str(run), "--row", "3")
    assert "controller.K=3 is read by nothing" in refused(capsys, str(run), "controller.K=3")
    assert "no arm 'arm_7'" in refused(capsys, "arm_7")
    assert "controller.KK" in refused(capsys, "arm_1", "controller.KK=3")
    assert "holds no trajectory.npz and no log.mcap" in refused(capsys, str(tmp_path))
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "needs viser: pip install 'apcc-torch[view]'" in refused(capsys, str(run), "--port", "0")


def test_a_free_port_is_found_and_a_taken_one_is_named(taken: socket.socket) -> None:
    assert WebAddress(port=0).free().port > 0
    with pytest.raises(ConfigError, match=r"^page\.port=\d+ of 127\.0\.0\.1 cannot be had .*choose another one, or 0"):
        WebAddress(port=taken.getsockname()[1]).free()
