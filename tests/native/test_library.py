"""Machine code that is kept: damaged it is built again, and where it cannot be had one sentence says why."""

from __future__ import annotations

import ctypes
import logging
import os
import random
import shutil
import stat
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.files import cache_folder
from apcc_torch.native.compiled import TorchStep, compiled
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.library import BUILD, keep, kept, swept_folder


class Doubles(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * x


ONE, ROWS = torch.ones(2), torch.arange(6.0).reshape(3, 2)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("APCC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    told = (record for record in caplog.records if record.name.startswith("apcc_torch"))
    return [record.getMessage() for record in told if record.levelno >= logging.WARNING]


def runs_eagerly(caplog: pytest.LogCaptureFixture) -> str:
    """Why, in one line; "aot" refuses with the same, and either computes or ends."""
    caplog.clear()
    with caplog.at_level(logging.WARNING, "apcc_torch"):
        step = compiled(Doubles(), (ONE,), "auto", rows=3)
    assert isinstance(step, TorchStep) and torch.equal(step(ROWS), 2.0 * ROWS)
    (said,) = warnings(caplog)
    why = said.removeprefix("Doubles is not compiled and runs eagerly: ")
    with pytest.raises(CompileError) as refused:
        compiled(Doubles(), (ONE,), "aot", rows=3)
    assert str(refused.value) == f"Doubles is not compiled; compile=auto or off runs it eagerly: {why}"
    assert "\n" not in why
    return why


def test_no_damage_is_loaded(folder: Path) -> None:
    """Whatever is cut off, zeroed or flipped, in the library or in its checksum."""
    rng = random.Random(7)
    made = rng.randbytes(5000)
    library = keep(made, "some.so")
    assert kept("some.so") == library and library.read_bytes() == made
    assert [p.name for p in sorted(folder.iterdir())] == ["some.so", "some.so.sha256"]
    for file in (library, folder / "some.so.sha256"):
        whole = file.read_bytes()
        for _ in range(15):
            at = rng.randrange(len(whole))
            flipped = bytes([whole[at] ^ (1 << rng.randrange(8))])
            for damaged in (
                whole[:at],
                whole[:at] + bytes(len(whole) - at),
                whole[:at] + flipped + whole[at + 1 :],
                whole + flipped,
            ):
                file.write_bytes(damaged)
                assert kept("some.so") is None, (file.name, at)
        file.unlink()
        assert kept("some.so") is None
        file.write_bytes(whole)
        assert kept("some.so") == library


def test_a_damaged_library_is_built_again(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    NativeFunction(Doubles(), (ONE,))(ROWS)
    # Elsewhere: this process has the first one loaded.
    again = tmp_path / "again"
    shutil.copytree(folder, again)
    monkeypatch.setenv("APCC_CACHE", str(again))
    (library,) = again.glob("*.so")
    (record,) = again.glob("*.json")
    with library.open("r+b") as file:  # as a crash leaves it: the size is there, and the end is not
        size = file.seek(0, os.SEEK_END)
        file.truncate(size // 2)
        file.truncate(size)
    with caplog.at_level(logging.WARNING, "apcc_torch"):
        assert torch.equal(NativeFunction(Doubles(), (ONE,))(ROWS), 2.0 * ROWS)
    assert warnings(caplog) == [f"the kept machine code {library} is damaged and is built again"]
    caplog.clear()
    NativeFunction(Doubles(), (ONE,))(ROWS)
    assert not warnings(caplog)
    record.write_bytes(record.read_bytes()[:-3])
    with caplog.at_level(logging.WARNING, "apcc_torch"):
        assert torch.equal(NativeFunction(Doubles(), (ONE,))(ROWS), 2.0 * ROWS)
    assert warnings(caplog) == [f"the kept machine code {record} is damaged and is built again"]


class Scaled(nn.Module):
    def __init__(self, factor: list[float]) -> None:
        super().__init__()
        self.register_buffer("factor", torch.tensor(factor))

    def forward(self, x: Tensor) -> Tensor:
        return self.factor * x + self.factor.square().sum() * x.sin()


def test_numbers_are_read_and_not_built_in(folder: Path) -> None:
    """Modules that differ in what they hold share a library and what is kept of its numbers, but for zeros."""
    given = ([2.0, 3.0], [0.7, 0.7], [1.0, -1.0], [1e-9, 7.0])
    for _ in range(2):
        for factor in given:
            module = Scaled(factor)
            torch.testing.assert_close(NativeFunction(module, (ONE,))(ROWS), module(ROWS))
        assert len(list(folder.glob("*.so"))) == 1 and len(list(folder.glob("*.json"))) == 1
    module = Scaled([0.0, 3.0])
    torch.testing.assert_close(NativeFunction(module, (ONE,))(ROWS), module(ROWS))
    assert len(list(folder.glob("*.so"))) == 2


def test_a_folder_that_cannot_hold_it(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.write_text("a file")
    begins = f"machine code cannot be kept in {folder}"
    assert runs_eagerly(caplog) == f"{begins}: it is no folder; name another folder in APCC_CACHE"
    monkeypatch.setenv("APCC_CACHE", str(folder / "below"))
    assert runs_eagerly(caplog).startswith(f"{begins}/below: it is no folder")
    monkeypatch.setenv("APCC_CACHE", "/proc/here")
    assert runs_eagerly(caplog).startswith("machine code cannot be kept in /proc/here: ")
    monkeypatch.delenv("APCC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    assert cache_folder() == folder / "apcc_torch" and "it is no folder" in runs_eagerly(caplog)


@pytest.mark.parametrize("compiler", ["false", "true", "no-such-compiler", "a folder", "a text"])
def test_a_compiler_that_does_not_compile(
    compiler: str, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if compiler == "a text":
        compiler = str(tmp_path / "cxx")
        Path(compiler).write_text("not a program")
        Path(compiler).chmod(0o700)
    elif compiler == "a folder":
        compiler = str(tmp_path)
    monkeypatch.setenv("CXX", compiler)
    assert compiler in runs_eagerly(caplog) or compiler == "true"
    assert not folder.exists() or not list(folder.iterdir())


def test_a_full_disk_leaves_nothing_behind(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert runs_eagerly(caplog).startswith(f"machine code cannot be kept in {folder}: No space left on device")
    assert not list(folder.iterdir())


def test_a_disk_that_runs_no_code(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def noexec(path: str) -> None:
        raise OSError(f"{path}: failed to map segment from shared object")

    monkeypatch.setattr(ctypes, "CDLL", noexec)
    assert runs_eagerly(caplog).startswith(f"machine code cannot be loaded: {folder}")


def test_code_that_another_may_write_is_not_run(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    mask = os.umask(0)
    try:
        NativeFunction(Doubles(), (ONE,)).program(1)
    finally:
        os.umask(mask)
    (library,) = folder.glob("*.so")
    assert [stat.S_IMODE(p.stat().st_mode) for p in (folder, library)] == [0o700, 0o600]
    ends = "and code from it is not run; name a folder of your own in APCC_CACHE"
    for path in (folder, library):
        was = stat.S_IMODE(path.stat().st_mode)
        for bit in (stat.S_IWGRP, stat.S_IWOTH):
            path.chmod(was | bit)
            with pytest.raises(CompileError, match=f"{path} may be written by other users, {ends}"):
                kept(library.name)
        path.chmod(was)
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    assert runs_eagerly(caplog) == f"{folder} belongs to another user, {ends}"


def test_what_torch_cannot_compile_is_one_sentence() -> None:
    class Branches(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x if x.sum() > 0 else -x

    step = compiled(Branches(), (ONE,), "inductor")
    with pytest.raises(CompileError, match=r"^Branches is not compiled by torch; compile=off runs it eagerly: .+$"):
        step(ONE)


def test_a_build_that_was_killed_is_swept_away_once_nobody_can_work_on_it(folder: Path) -> None:
    NativeFunction(Doubles(), (ONE,))(ROWS)
    assert not [path for path in folder.iterdir() if path.is_dir()]
    old, fresh = folder / f"{BUILD}old", folder / f"{BUILD}fresh"
    draft, other = folder / ".x.7.draft.so", folder / "mine"
    for made in (old, fresh, other):
        made.mkdir(parents=True)
        (made / "0.cpp").write_text("x")
    draft.touch()
    for each in (old, draft, other):
        os.utime(each, (1.0, 1.0))
    assert swept_folder() == folder
    assert not old.exists() and not draft.exists() and fresh.exists() and other.exists()
    assert any(path.suffix == ".so" for path in folder.iterdir())
