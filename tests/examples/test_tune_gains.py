"""The example runs in its reduced form, and its tuning lowers the cost that it is tuned on."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "tune_gains.py"


def test_quick() -> None:
    done = subprocess.run([sys.executable, str(EXAMPLE), "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    costs = re.search(r"^tuned on: cost ([\d.]+) -> ([\d.]+)", done.stdout, re.MULTILINE)
    assert costs is not None, done.stdout
    before, after = map(float, costs.groups())
    assert after < 0.98 * before
    # Every gain was moved, the window's weights too.
    gains = dict(re.findall(r"^(\w+): \[(.*)\]$", done.stdout, re.MULTILINE))
    assert set(gains) == {"K", "gamma", "null_gain", "normalisation", "window"}
    assert len(set(gains["window"].split(", "))) > 3
