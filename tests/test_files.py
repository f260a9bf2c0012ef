"""Files are whole or not there: what a failed write leaves behind, and what comes back from a good one."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch

from apcc_torch import files
from apcc_torch.errors import DataError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.files import (
    draft_of,
    json_in,
    read_arrays,
    read_text,
    write_arrays,
    write_atomically,
    write_json,
    yaml_in,
    yaml_text,
)
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.model.arm import Arm
from apcc_torch.model.mount import RigidMount
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.sweeps.sweep_folder import read_record
from odd_values import damaged_bytes, odd_mapping, odd_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(("content", "kept"), [(b"\x00\xff", b"\x00\xff"), ("µ\r\n\n", "µ\r\n\n".encode())])
def test_writes_the_bytes_given_into_a_new_folder(tmp_path: Path, content: bytes | str, kept: bytes) -> None:
    path = write_atomically(tmp_path / "a" / "b" / "file.txt", content)
    assert path == tmp_path / "a" / "b" / "file.txt" and path.read_bytes() == kept
    assert names(path.parent) == ["file.txt"]


def test_replaces_an_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("a longer old text")
    write_atomically(str(path), "new")
    assert path.read_text() == "new" and names(tmp_path) == ["file.txt"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(b"old")

    def refuse(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, step, refuse)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["file.txt"]


def test_a_draft_is_beside_the_file_with_its_suffix_and_moved_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "new" / "film.mp4"
    with draft_of(path) as draft:
        assert draft.parent == path.parent and draft.suffix == ".mp4" and draft != path
        draft.write_bytes(b"film")
        assert not path.exists()
    assert path.read_bytes() == b"film" and names(path.parent) == ["film.mp4"]


def test_a_draft_that_fails_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")

    def half_written() -> None:
        with draft_of(path) as draft:
            draft.write_bytes(b"half")
            raise RuntimeError("encoder died")

    with pytest.raises(RuntimeError, match="encoder"):
        half_written()
    assert path.read_bytes() == b"old" and names(tmp_path) == ["film.mp4"]


def test_json_keeps_numbers_and_order(tmp_path: Path) -> None:
    data = {"z": 0.1 + 0.2, "a": 1, "text": "ψ"}
    path = write_json(tmp_path / "m.json", data)
    back = json.loads(path.read_text(encoding="utf-8"))
    assert back == data and list(back) == ["z", "a", "text"]


def test_arrays_come_back_bit_for_bit(tmp_path: Path) -> None:
    q = torch.linspace(0, 1, 6, dtype=torch.float64).reshape(2, 3).requires_grad_()
    tensors = {"q": q, "k": torch.arange(3), "x": torch.rand(2, 2)}
    with np.load(write_arrays(tmp_path / "t.npz", tensors)) as back:
        assert set(back) == set(tensors)
        for name, tensor in tensors.items():
            want = tensor.detach().numpy()
            assert back[name].dtype == want.dtype and np.array_equal(back[name], want)


def test_arrays_of_a_damaged_archive_are_refused(tmp_path: Path) -> None:
    tensors = {"x": torch.arange(40.0), "flags": torch.ones(5, dtype=torch.bool)}
    path = write_arrays(tmp_path / "a.npz", tensors)
    assert all(torch.equal(read, tensors[name]) for name, read in read_arrays(path).items())
    whole, refused = path.read_bytes(), []
    for seed in range(300):
        path.write_bytes(damaged_bytes(whole, Random(seed)))
        try:
            assert all(isinstance(read, torch.Tensor) for read in read_arrays(path).values())
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 100 and all(said.startswith("a.npz ") and "\n" not in said for said in refused)


def test_arrays_that_are_no_tensors_or_too_large_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    for array in (np.array([{}], dtype=object), np.array(["a"]), np.array(["2026-01-01"], dtype="datetime64[s]")):
        np.savez(path, a=array)
        with pytest.raises(DataError, match=r"^a\.npz cannot be read: "):
            read_arrays(path)
    np.save(tmp_path / "b.npz", np.zeros(3))
    os.mkfifo(tmp_path / "c.npz")
    for name in ("b.npz.npy", "c.npz", "none.npz"):
        with pytest.raises(DataError, match=f"^{name} cannot be read: "):
            read_arrays(tmp_path / name)
    monkeypatch.setattr(files, "MOST_ARRAYS", 2**20)
    write_arrays(path, {"a": torch.zeros(2**18)})
    with pytest.raises(DataError, match="its arrays have over"):
        read_arrays(path)


def test_a_text_is_read_within_bounds(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("µ\n", encoding="utf-8")
    assert read_text(path, 3) == "µ\n"
    with pytest.raises(DataError, match=r"^a\.txt cannot be read: it has over"):
        read_text(path, 2)
    with pytest.raises(DataError, match="it is no file"):
        read_text(tmp_path)


@pytest.mark.parametrize("reader", [json_in, yaml_in])
def test_whatever_a_text_says_it_is_plain_values_or_refused(reader: Callable[[str, str], Any]) -> None:
    good = {"a": 1.5, "b": [1, {"c": None}], "d": "x"}
    assert reader(json.dumps(good), "it") == good
    refused = []
    for seed in range(1000):
        random = Random(seed)
        text = odd_mapping(good, random).decode("utf-8", "replace") if seed % 2 else f"a: {odd_text(random)}\n"
        try:
            assert len(repr(reader(text, "it"))) < 20_000
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 100 and all(said.startswith("it cannot be read: ") and "\n" not in said for said in refused)


@pytest.mark.parametrize("number", ["1e-3", "2E6", "-1.5e3", "1.e-2", ".5e1", "+1e+2", "1.5e-05"])
def test_a_number_in_yaml_is_one_however_its_exponent_is_written(number: str) -> None:
    """As in YAML 1.2, in JSON and on a command line; PyYAML alone reads a text."""
    assert yaml_in(f"a: {number}\nb: [{number}]\nc: '{number}'\n", "it") == {
        "a": float(number),
        "b": [float(number)],
        "c": number,
    }
    assert yaml_in(yaml_text({"a": number, "b": [float(number)]}), "it") == {"a": number, "b": [float(number)]}


def test_what_only_begins_as_a_number_in_yaml_is_text() -> None:
    for text in ("1e", "e3", "1e3m", "0.2e-3 m", "1e3.5", "v1e3", "1-2e3"):
        assert yaml_in(f"a: {text}\n", "it") == {"a": text}


# Own files, which no one else writes; and what reads within a bound of its own.
UNBOUNDED = {
    "composition/help.py", "composition/schema.py", "exporting/folder.py", "files.py",
    "hardware/dynamixel/models.py", "hardware/feetech/models.py", "native/build.py", "native/driver.py",
    "native/code.py", "native/kept_program.py", "native/library.py", "native/source.py",
    "report/page/html.py", "report/pictures.py",
}  # fmt: skip


def test_nothing_else_reads_a_file_whole() -> None:
    root = Path(files.__file__).parent
    whole = r"\.read_(text|bytes)\((encoding|\))|json\.loads?\(|np\.load\(|yaml\.(safe_)?load\(|file\.read\(\)"
    reads = re.compile(whole)
    found = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if reads.search(path.read_text(encoding="utf-8"))
    }
    assert found <= UNBOUNDED, found - UNBOUNDED


@pytest.mark.parametrize(
    "read",
    [
        ArmCalibration.load,
        RestCalibration.load,
        Arm.load,
        load_recording,
        lambda p: RigidMount(p, "a"),
        read_log,
        read_record,
    ],
)
def test_no_loader_waits_for_a_pipe_or_reads_for_ever(read: Callable[[Path], Any], tmp_path: Path) -> None:
    pipe, endless = tmp_path / "pipe.yaml", tmp_path / "endless.yaml"
    os.mkfifo(pipe)
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless):
        with pytest.raises(DataError, match="is no file"):
            read(path)
