"""Golden tests of frames, PSFs and plans of the shipped scenes."""

import pytest

from tests.golden import compare, scenes

TOLERANCE = 1e-3  # one count more or less where a value is rounded; 4e-4 was seen between two processors


def test_the_record_holds_every_shipped_scene() -> None:
    assert sorted(compare.read("scenes")) == scenes.names()


@pytest.mark.parametrize("name", scenes.names())
def test_a_scene_is_as_recorded(name: str) -> None:
    difference = compare.difference(compare.read("scenes")[name], scenes.record(name), TOLERANCE)
    assert not difference, difference
