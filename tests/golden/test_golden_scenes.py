"""Golden tests of frames, PSFs and plans: one shipped scene for each kind of head, eye and object."""

import pytest

from tests.golden import compare, scenes


def test_the_record_holds_every_shipped_scene() -> None:
    assert sorted(compare.read("scenes")) == scenes.names()


@pytest.mark.parametrize("name", scenes.SAMPLE)
def test_a_scene_is_as_recorded(name: str) -> None:
    assert scenes.difference(name) == ""
