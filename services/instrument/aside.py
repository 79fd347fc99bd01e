"""Work that needs no head, done beside its owner, who goes on meanwhile."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

EVERY_S = 0.05  # far below what a person calls a wait

Result = TypeVar("Result")


def aside(act: Callable[[], Result], meanwhile: Callable[[], None]) -> Result:
    """What `act` gives, or raises, on a thread of its own; until it is done `meanwhile` is called again and again."""
    with ThreadPoolExecutor(1, "aside") as other:
        result = other.submit(act)
        while wait([result], EVERY_S).not_done:
            meanwhile()
    return result.result()
