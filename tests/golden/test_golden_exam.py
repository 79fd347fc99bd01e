"""Golden tests of the exam: events and lamp changes at their virtual times."""

from collections.abc import Callable, Iterator

import pytest

from tests.golden import compare, exam


@pytest.fixture(scope="module")
def built() -> Iterator[Callable[[str], exam.Stage]]:
    with exam.instruments() as built:
        yield built


def test_the_record_holds_every_scenario() -> None:
    assert sorted(compare.read("exam")) == sorted(exam.SCENARIOS)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # of `lamp_lost`
@pytest.mark.parametrize("name", exam.SCENARIOS)
def test_a_scenario_is_as_recorded(name: str, built: Callable[[str], exam.Stage]) -> None:
    difference = compare.difference(compare.read("exam")[name], exam.play(built(name), name))
    assert not difference, difference
