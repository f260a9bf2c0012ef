"""The speed tables of README and docs/speed.md from docs/speed.json: `python benchmarks/readme.py` writes them.

docs/speed.json is what `python benchmarks/run.py --out docs/speed.json` saved last.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from page import between

from apcc_torch.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- speed: python benchmarks/readme.py -->", "<!-- /speed -->"
FIRST, FIRST_END = "<!-- first step: python benchmarks/readme.py -->", "<!-- /first step -->"

CLOCK, LANES, UNITS = 2.5e9, 8, 2
"""Of the floors: Hz, doubles of one vector, and vector operations in one cycle."""


class Line(NamedTuple):
    """What is said of a subject, the start of its rows' names, and other makers' rows with what they are called."""

    what: str
    name: str
    compiled: str = "aot"
    peers: tuple[tuple[str, str], ...] = ()


ONE_STEP = "control_step_float64_batch_1"
README = (
    Line("control step, one arm", ONE_STEP, "standing", (("NumPy", "control_step_numpy"),)),
    Line("control step, 4096 arms", "control_step_float64_batch_4096"),
    Line("tip and Jacobian, 4096 arms", "tip_and_jacobian_batch_4096", peers=(("SoRoMoX", "soromox"),)),
    Line("forward dynamics, one arm", "forward_dynamics_batch_1", peers=(("SoRoMoX", "soromox"),)),
    Line("forward dynamics, 4096 arms", "forward_dynamics_batch_4096", peers=(("SoRoMoX", "soromox"),)),
    Line("closed loop, a second of one arm", "closed_loop_1_rows",
         peers=(("SoRoMoX, open loop", "rollout_second_soromox_1_row"),)),
    Line("closed loop, a second of 4096 arms", "closed_loop_4096_rows"),
)  # fmt: skip
TORCH = (("torch.compile", "inductor"), ("AOTInductor", "aot_inductor"), ("NumPy", "control_step_numpy"))
CHAIN = (("SoRoMoX", "soromox"), ("pytorch-kinematics", "rigid_chain"))
CABLE = (("MuJoCo's cable, one", "rod_dynamics_mujoco_cable"),)
ALL = (
    Line("control step, one arm, called with tensors", ONE_STEP, peers=TORCH),
    Line("the same, a standing call", ONE_STEP, "standing"),
    Line("the same, after 20 ms of sleep", ONE_STEP, "standing_after_20_ms"),
    Line("the same, with empty caches", ONE_STEP, "standing_flushed"),
    Line("control step, 64 arms", "control_step_float64_batch_64"),
    Line("control step, 4096 arms", "control_step_float64_batch_4096", peers=TORCH[:1]),
    Line("the step that ships, one arm, called with tensors", "shape_step_float64_batch_1"),
    Line("the step that ships, 4096 arms", "shape_step_float64_batch_4096"),
    Line("tip and Jacobian, one arm", "tip_and_jacobian_batch_1", peers=CHAIN),
    Line("tip and Jacobian, 4096 arms", "tip_and_jacobian_batch_4096", peers=CHAIN),
    Line("regressor, 4096 arms", "regressor_batch_4096"),
    Line("algorithm 2, five iterations, 4096 arms", "algorithm_2_batch_4096"),
    Line("forward dynamics, one arm", "forward_dynamics_batch_1", peers=CHAIN[:1]),
    Line("forward dynamics, 256 arms", "forward_dynamics_batch_256", peers=CHAIN[:1]),
    Line("forward dynamics, 4096 arms", "forward_dynamics_batch_4096", peers=CHAIN[:1]),
    Line("forward dynamics of a rod, one", "rod_dynamics_batch_1", peers=CABLE),
    Line("forward dynamics of a rod, 4096", "rod_dynamics_batch_4096", peers=CABLE),
    Line("open loop, a second of one arm", "open_loop_1_rows",
         peers=(("SoRoMoX", "rollout_second_soromox_1_row"),)),
    Line("open loop, a second of 4096 arms", "open_loop_4096_rows"),
    Line("closed loop, a second of one arm", "closed_loop_1_rows"),
    Line("closed loop, a second of 60 arms", "closed_loop_60_rows"),
    Line("closed loop, a second of 4096 arms", "closed_loop_4096_rows"),
)  # fmt: skip


def spelled(microseconds: float) -> str:
    """A time in the unit that suits it, three digits at most."""
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if microseconds >= size:
            return f"{microseconds / size:.3g} {unit}"
    return f"{microseconds:.3g} µs"


def shown(line: Line, speed: dict[str, Any]) -> tuple[str, str, str, str]:
    """Eager, compiled, how many times as fast, and the peers, of one line."""
    compiled = speed[f"{line.name}_{line.compiled}"]["us_a_row"]
    eager = speed.get(f"{line.name}_eager", {}).get("us_a_row")
    beside = []
    for maker, row in line.peers:
        found = speed[row if row in speed else f"{line.name}_{row}"]["us_a_row"]
        beside.append(f"{maker}: {spelled(found)}, {found / compiled:.{0 if found > 9.5 * compiled else 1}f}×")
    if eager is None:
        return "", spelled(compiled), "", "; ".join(beside)
    return spelled(eager), spelled(compiled), f"{eager / compiled:.0f}×", "; ".join(beside)


def table(speed: dict[str, Any]) -> str:
    """The README's table and what it was measured on, as Markdown."""
    lines = ["| an arm's share of | eager | compiled | | beside |", "|---|---|---|---|---|"]
    lines += [f"| {line.what} | {' | '.join(shown(line, speed))} |" for line in README]
    return "\n".join([*lines, "", measured(speed)])


def whole_table(speed: dict[str, Any]) -> str:
    """The table of docs/speed.md: tails and floors too."""
    rod = speed["rod_pieces"]
    lines = [
        "| an arm's share of | eager | compiled | | p99.9 of the call | floor | beside |",
        "|---|---|---|---|---|---|---|",
    ]
    for line in ALL:
        eager, compiled, gain, beside = shown(line, speed)
        row = speed[f"{line.name}_{line.compiled}"]
        tail = spelled(row["p999_us"]) if "p999_us" in row else ""
        least = ""
        if "operations" in row:
            lanes = 1 if line.name.endswith("_batch_1") else LANES
            least = spelled(1e6 * row["operations"] / (CLOCK * lanes * UNITS * row["threads"]))
        lines.append(f"| {line.what} | {eager} | {compiled} | {gain} | {tail} | {least} | {beside} |")
    said = (
        f"The rod is clamped level and bends under its weight: {rod['sections']} sections, and MuJoCo's cable of "
        f"{rod['cable_edges']} edges, have its tip at rest within {100 * rod['accuracy']:g} % of its length. Floors: "
        f"{UNITS} operations a cycle at {CLOCK / 1e9:g} GHz on each core in use, of {LANES} doubles each, for one arm "
        "of one. They count the estimator's loop as often as it may run; where it ends sooner, a step is below."
    )
    call, waits = (speed[f"{ONE_STEP}_{name}"] for name in ("standing", "standing_only_waits"))
    said += (
        f" p99.9 of a standing call is {call['p999_us'] / call['median_us']:.1f} times its median; of a loop "
        f"that only reads the clock as long it is {waits['p999_us'] / waits['median_us']:.1f} times: the system "
        "interrupts both."
    )
    return "\n".join([*lines, "", said, "", measured(speed)])


STEPS = (
    ("the shipped controller, one arm", "control_step"),
    ("closed loop with the dynamic arm, 64 rows", "closed_loop"),
    ("the dynamic arm that comes to rest before it, 64 rows", "settling"),
    ("environment with the kinematic arm, 64 rows", "kinematic_environment"),
    ("environment with the dynamic arm, 64 rows", "environment"),
    ("the same with a controller that looks ahead", "environment_ahead"),
)


def first_table(speed: dict[str, Any]) -> str:
    """How long the first step of a structure takes, and of another arm of the same."""
    lines = ["| seconds to the first step | new structure | known, fresh process | known, same process | library |",
             "|---|---|---|---|---|"]  # fmt: skip
    for what, name in STEPS:
        times = [f"{1e-6 * speed[f'first_step_{name}_{case}']['us_a_row']:.2g}" for case in ("new", "known", "again")]
        lines.append(f"| {what} | {' | '.join(times)} | {speed[f'first_step_{name}_library']['kB']:.0f} kB |")
    return "\n".join(lines)


def measured(speed: dict[str, Any]) -> str:
    """What a run was measured on, and how long a program takes to begin."""
    machine, cold = speed["machine"], speed["cold_start"]
    return (
        f"From nothing to the first tip position: {spelled(cold['median_us'])}, all but "
        f"{spelled(cold['without_torch_us'])} of it the import of torch. Medians, float64, {machine['cpus']} cores of "
        f"an {machine['processor']}, torch {machine['torch']}, Python {machine['python']}."
    )


def with_table(text: str, speed: dict[str, Any], whole: bool = False) -> str:
    """The page with its tables in their places."""
    if whole:
        text = between(text, FIRST, FIRST_END, first_table(speed))
    return between(text, BEGIN, END, whole_table(speed) if whole else table(speed))


def main() -> None:
    """Writes both pages."""
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    for page, whole in ((ROOT / "README.md", False), (ROOT / "docs" / "speed.md", True)):
        write_atomically(page, with_table(page.read_text(encoding="utf-8"), speed, whole))


if __name__ == "__main__":
    main()
