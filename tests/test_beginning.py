"""Ctrl-C in the first second of a program, while torch is imported: the program ends as any command does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import apcc_torch
from apcc_torch.beginning import is_program

ROOT = Path(apcc_torch.__file__).resolve().parents[1]


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="what is loaded is told by Linux")
def test_it_says_nothing() -> None:
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "apcc_torch.simulate", "--help"]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        deadline = time.monotonic() + 60.0
        while "libtorch_cpu" not in Path(f"/proc/{process.pid}/maps").read_text():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60.0)[0] == b""
        assert process.returncode == -signal.SIGINT


@pytest.mark.parametrize(
    ("argv", "orig", "ours"),
    [
        (["-m"], ["python", "-m", "apcc_torch.report", "runs"], True),
        (["-m"], ["python", "-X", "dev", "-mapcc_torch.robot"], True),
        (["/usr/bin/apcc-simulate", "a=1"], ["python", "/usr/bin/apcc-simulate", "a=1"], True),
        (["-m"], ["python", "-m", "pytest", "tests"], False),
        (["-c"], ["python", "-c", "import apcc_torch"], False),
        (["my.py", "apcc_torch.robot"], ["python", "my.py", "apcc_torch.robot"], False),
        ([], [], False),
    ],
)
def test_only_a_program_of_the_package_changes_what_ctrl_c_does(
    argv: list[str], orig: list[str], ours: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", argv)
    monkeypatch.setattr(sys, "orig_argv", orig)
    assert is_program() == ours
