"""Libraries that tests build are theirs."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("APCC_CACHE", str(tmp_path_factory.mktemp("native")))
        yield
