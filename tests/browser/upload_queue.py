"""Real instrument whose upload queue has three visits: refused, without connection, not tried yet."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from tests.browser.real import Instruments, Real
from tests.journey.conftest import until
from tests.receiver import Receiver, receiving
from tests.site import identity


@dataclass
class Queue:
    """The instrument, its receiver, and its visits by age."""

    real: Real
    receiver: Receiver
    visits: list[str]

    @property
    def url(self) -> str:
        return self.real.url


@contextmanager
def queued(instruments: Instruments) -> Iterator[Queue]:
    folder = instruments.new_folder()
    certificate = identity(folder)
    with receiving(*certificate) as receiver:
        real = instruments.build(folder=folder, uploads=receiver.settings(folder, authority=certificate[0]))
        visits = []
        for answers, tried in (({"PUT": 400}, 1), ({"HEAD": 503}, 2), ({"HEAD": 503}, 2)):
            receiver.answers = answers
            visits.append(real.begin_visit(sex="woman", age=54)["id"])
            real.finish(visits[-1])
            until(partial(has_tried, real, tried))
        yield Queue(real, receiver, visits)
        real.close()


def waiting(real: Real) -> list[dict[str, Any]]:
    return list(real.request("GET", "/api/upload-queue")["visits"])


def has_tried(real: Real, count: int) -> bool:
    """Return whether the upload of `count` waiting visits was tried."""
    return sum(visit["tries"] > 0 for visit in waiting(real)) == count
