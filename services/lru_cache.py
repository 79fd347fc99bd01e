"""Cache of the values that were used last, for values that a caller makes from more than their key.

`functools.lru_cache` serves where the key is what the value is made from.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class LruCache(Generic[K, V]):
    """Values by key, at most `size` of them: a further one replaces the one that was not used for longest.

    Not thread-safe.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: dict[K, V] = {}  # the last one was used last

    def get(self, key: K) -> V | None:
        """Return the value of a key and count it as used; None without one."""
        if key not in self._values:
            return None
        self._values[key] = self._values.pop(key)
        return self._values[key]

    def put(self, key: K, value: V) -> None:
        """Store a value, in place of an earlier one of its key, and count it as used."""
        self._values.pop(key, None)
        self._values[key] = value
        if len(self._values) > self._size:
            del self._values[next(iter(self._values))]

    def get_or_make(self, key: K, make: Callable[[], V]) -> V:
        """Return the value of a key, made if there is none; an error of `make` stores nothing."""
        if key not in self._values:
            self.put(key, make())
        self._values[key] = self._values.pop(key)
        return self._values[key]
