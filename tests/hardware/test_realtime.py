"""The process as a loop wants it, and as it was afterwards."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator

import pytest
import torch

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.realtime import SWITCH_INTERVAL, freeze, realtime


@pytest.fixture
def thawed() -> Iterator[None]:
    """The tests' own process is frozen."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("thawed")
def test_everything_is_undone() -> None:
    before = sys.getswitchinterval(), torch.get_num_threads(), os.sched_getscheduler(0)
    with realtime():
        freeze()
        assert gc.get_freeze_count() > 0
        assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL) and torch.get_num_threads() == 1
    assert gc.get_freeze_count() == 0
    assert (sys.getswitchinterval(), torch.get_num_threads(), os.sched_getscheduler(0)) == before


@pytest.mark.usefixtures("thawed")
def test_what_the_caller_froze_stays_frozen() -> None:
    gc.freeze()
    with realtime():
        freeze()
    assert gc.get_freeze_count() > 0


def test_a_priority_is_set_or_refused_with_a_way_out() -> None:
    before, told = os.sched_getscheduler(0), ""
    try:
        with realtime(priority=1):
            assert os.sched_getscheduler(0) & os.SCHED_FIFO
    except HardwareError as error:
        told = str(error)
    assert told == "" or "limits.d" in told
    assert os.sched_getscheduler(0) == before
    with pytest.raises(HardwareError, match="priority=1000"), realtime(priority=1000):
        pass
