"""The example runs in its reduced form, and what it learns lowers the mapping error of set-points it has not seen."""

from __future__ import annotations

import re

from commands import example


def test_quick() -> None:
    told = "\n".join(example("layout_residual.py"))
    lines = re.findall(r"^held-out set-points, (.*?), (.*): mapping error ([\d.]+) cm$", told, re.MULTILINE)
    errors = {(where, way): float(error) for where, way, error in lines}
    assert len(errors) == 6, told
    assert errors["at rest", "coupled with the residual"] < 0.85 * errors["at rest", "coupled, as believed"]
    # So short a run is all start, where this little training does not show; but the loop has felt the residual.
    assert errors["in motion", "coupled with the residual"] != errors["in motion", "coupled, as believed"]
