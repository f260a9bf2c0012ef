"""The example runs in its reduced form, and its tuning lowers the cost that it is tuned on."""

from __future__ import annotations

import re

from commands import example


def test_quick() -> None:
    told = "\n".join(example("tune_gains.py"))
    costs = re.search(r"^tuned on: cost ([\d.]+) -> ([\d.]+)", told, re.MULTILINE)
    assert costs is not None, told
    before, after = map(float, costs.groups())
    assert after < 0.98 * before
    # Every gain was moved, the window's weights too.
    gains = dict(re.findall(r"^(\w+): \[(.*)\]$", told, re.MULTILINE))
    assert set(gains) == {"K", "gamma", "null_gain", "normalisation", "window"}
    assert len(set(gains["window"].split(", "))) > 3
