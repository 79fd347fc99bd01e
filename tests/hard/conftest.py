"""Margins: comparison of each measured figure with its bound and with the recorded figure of the README.

`within(measured, bound)` asserts the bound, which comes from theory or from what is acceptable to a viewer. It also
asserts that the figure is at most three times the recorded one (otherwise the bound is too far from the figure to
detect a change) and not clearly below it (otherwise the README is out of date). `python -m tests.hard.figures` records
the figures again.
"""

from collections.abc import Callable

import pytest

from tests.hard.figures import RECORDER, recorded

TIMES = 3.0
ROUNDING = 1e-4  # of the bound: tolerance for the rounding of another processor
FAINT = 0.02  # of the bound: figures below this may become smaller
REMEDY = "if this is meant, run python -m tests.hard.figures"


@pytest.fixture
def within(
    request: pytest.FixtureRequest, record_property: Callable[[str, object], None]
) -> Callable[[float, float], None]:
    """Return the check that a figure keeps its bound and agrees with the README; both are recorded."""
    before = [] if request.config.pluginmanager.hasplugin(RECORDER) else recorded().get(request.node.nodeid, [])
    count = 0

    def check(measured: float, bound: float) -> None:
        nonlocal count
        record_property("margin", [float(measured), float(bound)])  # plain floats, which xdist can serialise
        assert measured <= bound
        if count < len(before):
            seen = before[count][0]
            message = f"3 times away from what was seen, {seen:.3g}; {REMEDY}"
            assert measured <= max(TIMES * seen, ROUNDING * bound), message
            assert max(measured, FAINT * bound) >= seen / TIMES, message
        count += 1

    return check
