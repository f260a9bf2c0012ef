"""What every test shares: one torch thread, reproducible property tests, and the recorded data where there is any."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from skips import no_recording, pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401

# Tensors are tiny here: threads cost more than they bring, and parallel test workers would compete.
torch.set_num_threads(1)

settings.register_profile("local", deadline=None, max_examples=30)
settings.register_profile("fixed", settings.get_profile("local"), derandomize=True, database=None, print_blob=True)
settings.load_profile("fixed" if os.environ.get("CI") else "local")


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
