"""How large an exported step is, and how long a call takes: the table of docs/export.md.

python benchmarks/export.py            prints it
python benchmarks/export.py FOLDER     writes it into docs/export.md, and leaves the libraries in FOLDER
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from hydra import compose, initialize_config_dir
from page import between

from apcc_torch.composition.export import ExportSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.experiments.exported import run
from apcc_torch.files import write_atomically
from apcc_torch.sweeps.schemas import keep_schema

keep_schema("export_schema", ExportSettings)
PAGE = Path(__file__).resolve().parents[1] / "docs" / "export.md"
MARKS = "<!-- export: python benchmarks/export.py FOLDER -->", "<!-- /export -->"
ROWS = {
    "the paper's arm, fixed rest lengths": ("experiment=dynamic_run_2_tuned", "controller.adaptive=false"),
    "the paper's arm, the law that ships": ("experiment=dynamic_run_2_tuned",),
    "one section, fixed rest lengths, positions": (
        "arm.lengths=[0.2]",
        "arm.sensors=[0.2]",
        "feedback=position",
        "controller.adaptive=false",
    ),
}
ALONE = "covariance=false"
FLAGS = ("-std=c++17", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-exceptions", "-fno-rtti")
TIMED = """
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <vector>
#include "apcc.hpp"
#include "../test/vectors.hpp"
int main() {
    apcc::Controller controller;
    std::vector<double> took;
    for (int k = 0; k < 20000; ++k) {
        apcc::Measurement measurement = measurements[k % (steps - 3)];
        measurement.time = 0.01 * (k + 1);
        const auto begun = std::chrono::steady_clock::now();
        controller.step(measurement, targets[0]);
        took.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - begun).count());
    }
    std::sort(took.begin(), took.end());
    std::printf("%.1f %.1f\\n", took[took.size() / 10], took[took.size() / 2]);
}
"""


def told(*command: str | Path, folder: Path) -> str:
    """What a command prints."""
    done = subprocess.run([str(word) for word in command], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout


def exported(folder: Path, *words: str) -> Path:
    """A library's folder."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        settings = typed(compose("export", list(words)), ExportSettings)
    folder.mkdir(parents=True, exist_ok=True)
    run(settings, folder)
    return folder


def size(folder: Path, optimised: str) -> int:
    """Bytes of the code and its tables."""
    told("g++", *FLAGS, optimised, "-Iinclude", "-c", "src/apcc.cpp", "-o", f"made{optimised}.o", folder=folder)
    return int(told("size", f"made{optimised}.o", folder=folder).splitlines()[1].split()[0])


def row(folder: Path, name: str, words: tuple[str, ...]) -> str:
    """A line of the table."""
    made = exported(folder / re.sub(r"\W+", "_", name), *words, ALONE)
    sizes = {optimised: size(made, optimised) for optimised in ("-O2", "-Os")}
    (made / "examples" / "timed.cpp").write_text(TIMED)
    told("g++", *FLAGS, "-O2", "-Iinclude", "examples/timed.cpp", "made-O2.o", "-o", "timed", folder=made)
    quick, median = min(tuple(map(float, told("./timed", folder=made).split())) for _ in range(5))
    kb = " / ".join(f"{sizes[optimised] / 1e3:.0f} kB" for optimised in ("-O2", "-Os"))
    return f"| {name} | {kb} | {quick:.1f} µs | {median:.1f} µs |"


def main() -> None:
    """Measures, and prints or writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", help="where the libraries go; without it the table is only printed")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(given.folder or scratch)
        lines = [row(folder, name, words) for name, words in ROWS.items()]
    head = "| without the covariance | code at -O2 / -Os | quickest tenth | median |\n|---|---|---|---|"
    version = told("g++", "--version", folder=Path()).splitlines()[0]
    table = "\n".join((head, *lines, "", f"One call, -O2, of 20,000: the best of five runs; {version}, x86-64."))
    sys.stdout.write(table + "\n")
    if given.folder:
        write_atomically(PAGE, between(PAGE.read_text(encoding="utf-8"), *MARKS, table))


if __name__ == "__main__":
    main()
