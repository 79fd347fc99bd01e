"""What travels through the exam: a live picture, a press, and a press whose light is done."""

from collections import OrderedDict
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime

from device.recon.aim import Aim
from device.recon.verdict import Verdict
from device.values import EYES, Capture, Eye, Frame
from services.records.errand import Errand, Permit, permit_test_picture
from services.records.people import other_request
from services.records.underway import Lost

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

    def under_way(self, id: str) -> Lost:
        """What is written down of it before its light, under the name of its capture."""
        return Lost(id, self.eye, self.errand.visit, self.errand.slot, self.errand.tries)


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
    """The last presses by their idempotency keys. The caller must hold `Exam._turn`."""

    def __init__(self) -> None:
        self._presses: OrderedDict[str, Press] = OrderedDict()

    def known(self, key: str | None, eye: Eye, errand: Errand) -> Future[Capture] | None:
        """The answer to this press, if there was one with this key lately; InputError if that was another press."""
        press = None if key is None else self._presses.get(key)
        if press is None:
            return None
        before = press.eye, press.errand.visit, press.errand.slot
        if before != (eye, errand.visit, errand.slot):
            raise other_request()
        return press.answer

    def remember(self, key: str, press: Press) -> None:
        """From now on this key is that press."""
        self._presses[key] = press
        while len(self._presses) > REMEMBERED:
            self._presses.popitem(last=False)
