"""The example runs in its reduced form, and what it learns lowers the mapping error of set-points it has not seen."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "layout_residual.py"


def test_quick() -> None:
    done = subprocess.run([sys.executable, str(EXAMPLE), "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = re.findall(r"^held-out set-points, (.*?), (.*): mapping error ([\d.]+) cm$", done.stdout, re.MULTILINE)
    errors = {(where, way): float(error) for where, way, error in lines}
    assert len(errors) == 6, done.stdout
    assert errors["at rest", "coupled with the residual"] < 0.85 * errors["at rest", "coupled, as believed"]
    # So short a run is all start, where this little training does not show; but the loop has felt the residual.
    assert errors["in motion", "coupled with the residual"] != errors["in motion", "coupled, as believed"]
