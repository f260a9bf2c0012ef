"""The README's speed table from docs/speed.json: `python benchmarks/readme.py` writes it between its two marks.

docs/speed.json is what `python benchmarks/run.py --out docs/speed.json` saved last.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from page import between

from apcc_torch.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- speed: python benchmarks/readme.py -->", "<!-- /speed -->"

# What is said of a row, its eager twin, its peer's row, and the peer's name.
LINES = (
    ("control step, one arm", "control_step_float64_batch_1", "control_step_numpy", "NumPy"),
    ("control step, 4096 arms", "control_step_float64_batch_4096", None, ""),
    ("forward dynamics, one arm", "forward_dynamics_batch_1", "forward_dynamics_batch_1_soromox", "SoRoMoX"),
    ("forward dynamics, 256 arms", "forward_dynamics_batch_256", "forward_dynamics_batch_256_soromox", "SoRoMoX"),
    ("forward dynamics, 4096 arms", "forward_dynamics_batch_4096", "forward_dynamics_batch_4096_soromox", "SoRoMoX"),
    ("closed loop, a second of one arm", "closed_loop_1_rows", "rollout_second_soromox_1_row", "SoRoMoX, open loop"),
    ("closed loop, a second of 60 arms", "closed_loop_60_rows", None, ""),
    ("closed loop, a second of 4096 arms", "closed_loop_4096_rows", None, ""),
)


def spelled(microseconds: float) -> str:
    """A time in the unit that suits it, three digits at most."""
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if microseconds >= size:
            return f"{microseconds / size:.3g} {unit}"
    return f"{microseconds:.3g} µs"


def table(speed: dict[str, Any]) -> str:
    """The table and what it was measured on, as Markdown."""
    lines = ["| an arm's share of | eager | compiled | | beside |", "|---|---|---|---|---|"]
    for what, name, peer, peer_name in LINES:
        eager, compiled = speed[f"{name}_eager"], speed[f"{name}_aot"]
        beside = ""
        if peer is not None:
            times = speed[peer]["us_a_row"] / compiled["us_a_row"]
            beside = f"{peer_name}: {spelled(speed[peer]['us_a_row'])}, {times:.0f}×"
        gain = eager["us_a_row"] / compiled["us_a_row"]
        lines.append(
            f"| {what} | {spelled(eager['us_a_row'])} | {spelled(compiled['us_a_row'])} | {gain:.0f}× | {beside} |"
        )
    machine, cold = speed["machine"], speed["cold_start"]
    lines += [
        "",
        f"From nothing to the first tip position: {spelled(cold['median_us'])}, all but "
        f"{spelled(cold['without_torch_us'])} of it the import of torch. Medians, float64, {machine['cpus']} cores of "
        f"an {machine['processor']}, torch {machine['torch']}, Python {machine['python']}.",
    ]
    return "\n".join(lines)


def with_table(readme: str, speed: dict[str, Any]) -> str:
    """The README with the table in its place."""
    return between(readme, BEGIN, END, table(speed))


def main() -> None:
    """Writes the README."""
    readme = ROOT / "README.md"
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    write_atomically(readme, with_table(readme.read_text(encoding="utf-8"), speed))


if __name__ == "__main__":
    main()
