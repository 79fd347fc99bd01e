"""Margins: what a test saw of its bound, recorded with the test, so that the README's figures can be made of them."""

from collections.abc import Callable

import pytest


@pytest.fixture
def within(record_property: Callable[[str, object], None]) -> Callable[[float, float], None]:
    """Assert that a figure keeps its bound, and record both: "figure of bound"."""

    def hold(measured: float, bound: float) -> None:
        record_property("margin", f"{measured:.3g} of {bound:.3g}")
        assert measured <= bound

    return hold
