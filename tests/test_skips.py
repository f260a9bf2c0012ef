"""Where CI is set, a test that is skipped has failed, unless it wants recorded data."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
FILES = {
    "test_tests.py": (
        "import pytest, skips\n"
        "def test_runs(): pass\n"
        "def test_recorded(): skips.no_recording('arm.csv')\n"
        "def test_package(): pytest.importorskip('no_such_package')\n"
        "@pytest.mark.skip(reason='too slow')\n"
        "def test_marked(): pass\n"
        "@pytest.mark.xfail(strict=True)\n"
        "def test_expected(): assert False\n"
        "@pytest.fixture\n"
        "def browser(): pytest.skip('no browser')\n"
        "def test_set_up(browser): pass\n"
    ),
    "test_file.py": "import pytest\npytest.importorskip('no_such_package')\ndef test_never(): pass\n",
}


@pytest.mark.parametrize("ci", ["", "true"])
def test_a_skip_fails_where_ci_is_set(ci: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", ci)
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    command = [sys.executable, "-m", "pytest", "-p", "skips", "-p", "no:cacheprovider", "-q", "-c", "/dev/null"]
    done = subprocess.run(
        [*command, "--continue-on-collection-errors", "."], cwd=tmp_path, capture_output=True, text=True
    )
    told = done.stdout.splitlines()[-1]
    if not ci:
        assert done.returncode == 0 and told.startswith("1 passed, 5 skipped, 1 xfailed"), done.stdout
        return
    assert done.returncode == 1 and told.startswith("1 failed, 1 passed, 1 skipped, 1 xfailed, 3 errors"), done.stdout
    for name in ("test_package", "test_marked", "test_set_up", "test_file.py"):
        assert f"{name} was not run, and CI runs everything; install what it needs: Skipped: " in done.stdout, name
