"""Completeness of the tests: each recorded test is collected, under its own name or that in `moved_tests.txt`."""

import pytest

from tests.golden import compare
from tests.golden.collected_tests import MOVED, collected, flat, lost, mapped, moves, unneeded

MOVES = {
    "tests/old/": "tests/new/",
    "tests/old/test_b.py": "tests/c.py",
    "tests/old/test_a.py::test_x": "tests/y.py::test_y",
}


def test_every_recorded_test_is_collected() -> None:
    recorded, moved = flat(compare.read("tests")), moves(MOVED.read_text(encoding="utf-8").splitlines())
    assert not unneeded(recorded, moved)
    missing = lost(recorded, collected(), moved)
    assert not missing, "\n".join(["not collected; name the new test in tests/golden/moved_tests.txt:", *missing])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("tests/old/test_a.py::test_z[1]", "tests/new/test_a.py::test_z[1]"),
        ("tests/old/test_b.py::test_z", "tests/c.py::test_z"),
        ("tests/old/test_a.py::test_x[1]", "tests/y.py::test_y[1]"),
        ("tests/old/test_a.py::test_xx", "tests/new/test_a.py::test_xx"),
        ("tests/other.py::test_x", "tests/other.py::test_x"),
    ],
)
def test_the_longest_old_name_is_replaced(old: str, new: str) -> None:
    assert mapped(old, MOVES) == new


def test_a_test_that_is_not_collected_is_lost() -> None:
    recorded = ["a.py::test_1", "a.py::test_2[x]", "a.py::test_3"]
    assert lost(recorded, ["b.py::test_1", "b.py::test_2[x]"], {"a.py": "b.py"}) == ["a.py::test_3 -> b.py::test_3"]
    assert lost(["a.py::test_2[x]"], ["a.py::test_2[y]"], moves(["a.py::test_2[x] => a.py::test_2"])) == []
    assert unneeded(recorded, {"c.py": "d.py"}) == ["c.py"]
    with pytest.raises(ValueError, match="form"):
        moves(["a.py b.py"])
