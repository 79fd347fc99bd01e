"""The exam tells the same events and switches the lamp at the same virtual moments as when its record was written."""

from collections.abc import Callable, Iterator

import pytest

from tests.golden import compare, exam


@pytest.fixture(scope="module")
def built() -> Iterator[Callable[[str], exam.Stage]]:
    with exam.instruments() as built:
        yield built


def test_the_record_holds_every_scenario() -> None:
    assert sorted(compare.read("exam")) == sorted(exam.SCENARIOS)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # a lamp that cannot be darkened
@pytest.mark.parametrize("name", exam.SCENARIOS)
def test_a_scenario_is_as_recorded(name: str, built: Callable[[str], exam.Stage]) -> None:
    difference = compare.difference(compare.read("exam")[name], exam.play(built(name), name))
    assert not difference, difference
