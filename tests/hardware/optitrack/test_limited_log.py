"""At most one warning of a kind per interval, and the number of those left out."""

from __future__ import annotations

import logging
import time

import pytest

from apcc_torch.hardware.mocap.limited_log import LimitedLog


def test_each_kind_has_its_own_limit(caplog: pytest.LogCaptureFixture) -> None:
    log = LimitedLog(logging.getLogger("limited"), interval=0.05)
    with caplog.at_level(logging.WARNING):
        for i in range(10):
            log.warning("one", "one %d", i)
            log.warning("two", "two")
        time.sleep(0.06)
        log.warning("one", "one %d", 10)
    assert [record.getMessage() for record in caplog.records] == ["one 0", "two", "one 10 (9 more like it)"]


def test_the_stack_is_shown_on_demand(caplog: pytest.LogCaptureFixture) -> None:
    log = LimitedLog(logging.getLogger("limited"))
    with caplog.at_level(logging.WARNING):
        try:
            raise KeyError("x")
        except KeyError:
            log.warning("failed", "it failed", trace=True)
    assert "KeyError: 'x'" in caplog.text
