"""What may be skipped where CI is set: what compares with recorded data that is not there, and nothing else.

Elsewhere a test also skips for want of a package or a browser.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from typing import NoReturn

import pytest

ABSENT = "no recorded data"


def no_recording(what: str) -> NoReturn:
    """Skips for want of recorded data, and names it."""
    pytest.skip(f"{ABSENT}: {what}")


def judged(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Makes a failure of a skip that CI does not allow."""
    if not os.environ.get("CI") or not report.skipped or hasattr(report, "wasxfail"):
        return
    why = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    if ABSENT not in why:
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} was not run, and CI runs everything; install what it needs: {why}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Judges every test."""
    report = yield
    judged(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Judges every file that skips as a whole."""
    report = yield
    judged(report)
    return report
