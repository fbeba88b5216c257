"""A plugin of pytest for a copy of the package without extensions: a test that needs one is skipped, not failed."""

from __future__ import annotations

import re
from collections.abc import Generator

import pytest

MISSING = re.compile(r"extension \w+ is not installed|No module named 'mitsuba_plenoptic\.extensions")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Skip a file that imports a name of a missing extension."""
    report = yield
    if report.failed and (found := MISSING.search(str(report.longrepr))):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, found[0])
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip a test that a missing extension has stopped."""
    report = yield
    if report.failed and (found := MISSING.search(report.longreprtext + report.capstderr)):
        report.outcome, report.longrepr = "skipped", (str(item.path), 0, found[0])
    return report
