"""What travels through the exam: a live picture, a press, and a press whose light is done."""

from collections import OrderedDict
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime

from device.recon.aim import Aim
from device.recon.verdict import Verdict
from device.values import EYES, Capture, Eye, Frame
from services.records.errand import Errand, Permit, permit_test_picture

REMEMBERED = 32  # presses whose key is known, so that a request which the network repeats makes one picture


@dataclass(frozen=True)
class Preview:
    """One live picture: its number, its JPEG, when it was exposed, and what to do so that one can be taken."""

    number: int
    jpeg: bytes
    exposed_s: float
    aim: Aim


@dataclass(frozen=True)
class LiveRequest:
    """A request for live pictures: the eyes that their light counts for, and `permit` as in `Errand`."""

    eyes: tuple[Eye, ...] = EYES
    permit: Permit = permit_test_picture


NO_VISIT = LiveRequest()


@dataclass(frozen=True)
class Press:
    """Who waits for a picture, of which eye, and what for; `key` is the name that the page gave it."""

    answer: Future[Capture]
    eye: Eye
    errand: Errand
    key: str | None


@dataclass(frozen=True)
class Exposed:
    """A press whose light is done: what is left needs no eye."""

    press: Press
    id: str
    taken_at: datetime
    frame: Frame
    dark: Frame
    expose_s: float
    light: dict[str, object]
    verdict: Verdict


class Keys:
    """The last presses by the names that pages gave them; whoever uses it holds the exam's turn."""

    def __init__(self) -> None:
        self._answers: OrderedDict[str, Future[Capture]] = OrderedDict()

    def known(self, key: str | None) -> Future[Capture] | None:
        """The answer to a press with this key, if there was one lately."""
        return None if key is None else self._answers.get(key)

    def remember(self, key: str, answer: Future[Capture]) -> None:
        """From now on this key is that press."""
        self._answers[key] = answer
        while len(self._answers) > REMEMBERED:
            self._answers.popitem(last=False)
