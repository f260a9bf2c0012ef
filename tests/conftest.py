"""What every test shares: one torch thread, reproducible property tests, and the recorded data where there is any."""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from skips import no_recording, pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401

# Tensors are tiny here: threads cost more than they bring, and parallel test workers would compete.
torch.set_num_threads(1)

# Ignored where a shell starts the tests in its background; tests send it, to themselves and to what they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Files of few but long tests: none of them is to run alone at the end.
LONG = (
    "hardware/test_faults_end_to_end.py",
    "sweeps/test_launchers.py",
    "simulation/test_rollout.py",
    "native/test_steps.py",
    "native/test_models.py",
    "native/test_structure_kept.py",
    "exporting/test_steps.py",
    "exporting/test_folder.py",
    "tests/test_robot.py",
    "sweeps/test_resume.py",
    "sweeps/test_search.py",
    "sweeps/test_stops.py",
    "experiments/test_identification.py",
    "hardware/test_emulated_platform.py",
    "tests/test_tutorials.py",
    "viewing/test_pages.py",
    "examples/test_learning_examples.py",
    "examples/test_reach_ahead.py",
    "examples/test_tune_gains.py",
    "model/test_models_soromox.py",
    "model/test_soromox.py",
    "identification/test_fit.py",
    "evaluation/test_leaderboard.py",
    "recordings/test_worked_examples.py",
    "control/test_shape_law.py",
    "paper/test_arm_series.py",
    "tests/test_simulate.py",
    "tests/test_benchmark.py",
)

settings.register_profile("local", deadline=None, max_examples=30)
settings.register_profile("fixed", settings.get_profile("local"), derandomize=True, database=None, print_blob=True)
settings.load_profile("fixed" if os.environ.get("CI") else "local")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--every-kind", action="store_true", help="run the whole table of faults on every kind of emulated motors"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files begin first, then those of the most tests."""
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: (not item.path.as_posix().endswith(LONG), -tests[item.path]))


def pytest_collection_finish() -> None:
    """What is imported stays: no garbage collection need look at its 700,000 objects, for half a second each time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded data: APCC_DATA if set, else shared/data beside the checkout; skips if it is absent."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("APCC_DATA") or beside)
    if not folder.is_dir():
        no_recording(f"{folder} is no folder; APCC_DATA names another")
    return folder


@pytest.fixture(autouse=True, scope="session")
def own_libraries(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Machine code that tests build is theirs, shared between parallel workers, and built quickly."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "libraries"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("APCC_CACHE", str(folder))
        patch.setenv("CXXFLAGS", "-Og")
        yield


@pytest.fixture(autouse=True)
def own_logging() -> Iterator[None]:
    """A program that a test runs in this process sets its logging up: the next test has it as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
