"""Cache of the values used last: what it keeps, and that it keeps no more than its size."""

import weakref

import pytest

from services.lru_cache import LruCache


class Value:
    """Value whose end can be seen."""


def test_a_further_value_replaces_the_one_not_used_for_longest() -> None:
    cache = LruCache[str, int](2)
    cache.put("a", 1)
    cache.put("b", 2)
    assert cache.get("a") == 1
    cache.put("c", 3)
    assert [cache.get(key) for key in "abc"] == [1, None, 3]


def test_a_value_is_made_once_and_stays_while_it_is_used() -> None:
    cache = LruCache[str, int](2)
    made: list[str] = []

    def value(key: str) -> int:
        def make() -> int:
            made.append(key)
            return len(made)

        return cache.get_or_make(key, make)

    assert [value(key) for key in "abacab"] == [1, 2, 1, 3, 1, 4]
    assert made == ["a", "b", "c", "b"]


def test_a_dropped_or_replaced_value_is_held_no_longer() -> None:
    cache = LruCache[int, Value](2)
    seen = []
    for number in (0, 1, 1, 2, 3):
        value = Value()
        seen.append(weakref.ref(value))
        cache.put(number, value)
    del value
    assert [reference() is not None for reference in seen] == [False, False, False, True, True]


def test_a_failed_making_drops_nothing() -> None:
    cache = LruCache[str, int](1)
    cache.put("a", 1)
    with pytest.raises(ZeroDivisionError):
        cache.get_or_make("b", lambda: 1 // 0)
    assert cache.get("a") == 1
