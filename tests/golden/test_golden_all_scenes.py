"""Golden tests of frames, PSFs and plans of the shipped scenes that `make test-golden` leaves out."""

import pytest

from tests.golden import scenes


@pytest.mark.parametrize("name", sorted({*scenes.names()} - {*scenes.SAMPLE}))
def test_a_scene_is_as_recorded(name: str) -> None:
    assert scenes.difference(name) == ""
