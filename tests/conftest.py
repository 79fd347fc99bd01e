"""Hypothesis profile of all tests: the same examples everywhere, no deadline; tests of hazards are not skipped."""

from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import settings

from tests.hazards import control_tests

settings.register_profile("project", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("project")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[Any]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Let a test of a control of `hardware/risk/hazards.toml` fail where it would be skipped."""
    report = yield
    if report.skipped and item.nodeid.partition("[")[0] in control_tests():
        report.outcome, report.longrepr = "failed", f"{report.longrepr}: a test of a hazard's control must run"
    return report
