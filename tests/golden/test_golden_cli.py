"""Golden tests of the command line, and of the codes in the sources."""

from typing import Any

import pytest

from tests.golden import command_line, compare, error_codes


@pytest.fixture(scope="module")
def present() -> dict[str, Any]:
    """Return the present record of the command line, from one process for all tests."""
    return command_line.record()


@pytest.mark.parametrize("part", ["commands", "calls", "programs"])
def test_the_command_line_is_as_recorded(part: str, present: dict[str, Any]) -> None:
    difference = compare.difference(compare.read("command-line")[part], present[part])
    assert not difference, difference


def test_every_command_is_called_well_or_badly() -> None:
    recorded = compare.read("command-line")
    calls = [f"{call['call']} " for call in recorded["calls"]]
    names = list(recorded["commands"])
    leaves = [name for name in names if not any(other.startswith(f"{name} ") for other in names)]
    called = [name for name in leaves if any(call.startswith(f"{name} ") for call in calls)]
    assert called == leaves


@pytest.mark.parametrize("part", ["errors", "codes"])
def test_codes_are_as_recorded(part: str) -> None:
    difference = compare.difference(compare.read("errors")[part], error_codes.record()[part])
    assert not difference, difference
