"""Margins: what a test sees of its bound, compared with what was recorded when the README's figures were made.

`within(measured, bound)` asserts the bound, which comes from theory or from what a person would accept, and beside it
that the figure is at most three times the recorded one (a bound far above what is seen guards nothing) and not clearly
below it (then the README says too much). `python -m tests.hard.figures` records anew.
"""

from collections.abc import Callable

import pytest

from tests.hard.figures import RECORDER, recorded

TIMES = 3.0
ROUNDING = 1e-4  # of the bound: what another processor's rounding may change
FAINT = 0.02  # of the bound: what is below may well become smaller
REMEDY = "if this is meant, run python -m tests.hard.figures"


@pytest.fixture
def within(
    request: pytest.FixtureRequest, record_property: Callable[[str, object], None]
) -> Callable[[float, float], None]:
    """Assert that a figure keeps its bound, and that it is the one in the README; both are recorded."""
    before = [] if request.config.pluginmanager.hasplugin(RECORDER) else recorded().get(request.node.nodeid, [])
    count = 0

    def hold(measured: float, bound: float) -> None:
        nonlocal count
        record_property("margin", [float(measured), float(bound)])  # numbers that xdist can send
        assert measured <= bound
        if count < len(before):
            seen = before[count][0]
            said = f"3 times away from what was seen, {seen:.3g}; {REMEDY}"
            assert measured <= max(TIMES * seen, ROUNDING * bound), said
            assert max(measured, FAINT * bound) >= seen / TIMES, said
        count += 1

    return hold
