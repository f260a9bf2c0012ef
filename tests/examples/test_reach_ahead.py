"""The example that looks ahead in an environment does so: its controllers that do are nearer to their goals."""

from __future__ import annotations

import re

from commands import example


def test_quick() -> None:
    told = "\n".join(example("reach_ahead.py", "lookahead.tip_spread=0.8"))
    ends = {
        name.strip(): float(end) for name, end in re.findall(r"^(.*?) +\d+ of 2.*at the end +([\d.]+) mm", told, re.M)
    }
    assert list(ends) == ["standard", "law", "look ahead, lengths fixed", "look ahead, law"], told
    assert ends["look ahead, lengths fixed"] < 0.5 * ends["standard"], told
    assert ends["look ahead, law"] < 0.5 * ends["law"], told
