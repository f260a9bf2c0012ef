"""Files are whole or not there: what a failed write leaves behind, and what comes back from a good one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.files import draft_of, write_arrays, write_atomically, write_json


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
