"""What waits to be sent, and the one who sends it: whatever happens, each finish arrives, once."""

import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from device.clock import VirtualClock
from device.errors import (
    Busy,
    DiffuscopeError,
    SendLocked,
    SendRejected,
    SendUnlike,
    SendUnreachable,
    SendUntrusted,
)
from device.values import Capture
from services.instrument.carrier import Parcel
from services.instrument.sending import FIRST_S, LAST_S, Sender, packer
from services.records.outbox import PATIENCE, Outbox, Receipt
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import Store

keys = (f"{number:016x}" for number in count(1))
MEMORY = Path("/dev/shm")
LINK = SendUnreachable("no answer")


@dataclass
class Shelf:
    """A shelf with people on it, in virtual time."""

    store: Store
    clock: VirtualClock
    people: People = field(init=False)
    outbox: Outbox = field(init=False)

    def __post_init__(self) -> None:
        self.people = People(self.store.engine, load_protocol(), self.clock)
        self.outbox = Outbox(self.store.engine, self.clock)

    def begin(self) -> str:
        self.clock.sleep(60)
        return self.people.answer(next(keys), self.people.begin(next(keys)).id, "consent", "agreed").id

    def finish(self, visit: str) -> str:
        self.clock.sleep(1)
        return self.people.finish(next(keys), visit).id

    def finished(self) -> str:
        return self.finish(self.begin())

    def reopen(self, visit: str) -> None:
        self.people.reopen(next(keys), visit)

    def take(self, visit: str, slot: str = "R-centre") -> None:
        self.clock.sleep(1)
        eye = "OD" if slot[0] == "R" else "OS"
        errand = self.people.errand(eye, None, visit, slot)  # type: ignore[arg-type]
        report = {"visit": visit, "slot": slot, "verdict": None}
        id = f"{self.clock.wall():%Y%m%dT%H%M%S}-{eye}"
        capture = Capture(id, eye, self.clock.wall(), True, "00ff", report, {})  # type: ignore[arg-type]
        self.store.keep(capture, {"picture.png": b"png", "report.json": b"{}", "raw.tiff": b"raw"}, errand.beside)

    def waits(self) -> list[str]:
        return [one.visit for one in self.outbox.waiting()]


@pytest.fixture
def shelf() -> Iterator[Shelf]:
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        Store(Path(folder), reserve_bytes=0) as store,
    ):
        yield Shelf(store, VirtualClock(datetime(2026, 3, 1, tzinfo=UTC)))


@dataclass
class Van:
    """A carrier in this process: what it brought, and the errors that it will meet, one per delivery."""

    errors: list[DiffuscopeError] = field(default_factory=list)
    brought: list[Parcel] = field(default_factory=list)
    tried: int = 0
    between: Callable[[], None] = lambda: None
    aborted: bool = False

    def deliver(self, parcel: Parcel, pause: Callable[[], None]) -> Receipt:
        self.tried += 1
        pause()
        self.between()
        if self.errors:
            raise self.errors.pop(0)
        self.brought.append(parcel)
        return Receipt(parcel.sha256, "sha256")

    def abort(self) -> None:
        self.aborted = True


def sender(shelf: Shelf, van: Van, is_idle: Callable[[], bool] = lambda: True) -> Sender:
    return Sender(shelf.outbox, packer(shelf.store, shelf.people), van, is_idle, shelf.clock, chance=lambda: 0.0)


# The question


def test_a_finish_waits_an_undo_does_not_and_a_new_finish_waits_again(shelf: Shelf) -> None:
    visit = shelf.begin()
    assert shelf.waits() == []
    shelf.finish(visit)
    assert shelf.waits() == [visit]
    shelf.reopen(visit)
    assert (shelf.waits(), shelf.outbox.trouble().waiting) == ([], 0)
    shelf.finish(visit)
    shelf.outbox.arrived(shelf.outbox.waiting()[0], Receipt("0" * 64, "sha256"))
    assert shelf.waits() == []
    assert shelf.outbox.sent(shelf.people.get(visit).day) == 1
    shelf.reopen(visit)
    assert shelf.waits() == []
    shelf.finish(visit)
    assert shelf.waits() == [visit]
    assert shelf.outbox.sent(shelf.people.get(visit).day) == 0


def test_what_was_changed_while_it_was_sent_waits_again(shelf: Shelf) -> None:
    visit = shelf.finished()
    (under_way,) = shelf.outbox.waiting()
    shelf.reopen(visit)
    shelf.outbox.arrived(under_way, Receipt("0" * 64, "sha256"))
    assert shelf.waits() == []
    shelf.finish(visit)
    assert shelf.waits() == [visit]


def test_a_picture_that_comes_after_the_finish_is_sent_too(shelf: Shelf) -> None:
    visit = shelf.begin()
    errand = shelf.people.errand("OD", None, visit, "R-centre")
    shelf.finish(visit)
    van = Van()
    assert sender(shelf, van).step()
    capture = Capture("late", "OD", shelf.clock.wall(), True, "00ff", {"visit": visit, "slot": "R-centre"}, {})
    shelf.clock.sleep(1)
    shelf.store.keep(capture, {"picture.png": b"png", "report.json": b"{}"}, errand.beside)
    assert shelf.waits() == [visit]
    assert sender(shelf, van).step()
    assert [len(names(parcel)) for parcel in van.brought] == [2, 4]


def names(parcel: Parcel) -> list[str]:
    with zipfile.ZipFile(io.BytesIO(parcel.content)) as archive:
        return archive.namelist()


def test_who_waits_has_a_size_and_a_place_in_the_line(shelf: Shelf) -> None:
    first, second = shelf.begin(), shelf.begin()
    shelf.take(second)
    shelf.take(second)
    for visit in (second, first):
        shelf.finish(visit)
    found = shelf.outbox.waiting(sizes=True)
    assert [(one.visit, one.size_bytes) for one in found] == [(second, 2 * len(b"png{}")), (first, 0)]
    assert [one.visit for one in shelf.outbox.waiting(1)] == [second]


# The one who sends


def test_each_visit_is_sent_once_the_oldest_first_and_named_by_its_content(shelf: Shelf) -> None:
    visits = [shelf.finished() for _ in range(3)]
    van = Van()
    mine = sender(shelf, van)
    while mine.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in van.brought] == visits
    assert all(parcel.sha256[:16] in parcel.name for parcel in van.brought)
    assert mine.counts() == {"sent": 3, "waiting": 0}
    assert mine.standing() == {}


def test_a_parcel_is_the_same_tomorrow(shelf: Shelf) -> None:
    """`undo_until` ends at midnight; a name that changed with it would send everybody twice."""
    visit = shelf.finished()
    pack = packer(shelf.store, shelf.people)
    today = pack(visit)
    shelf.clock.sleep(2 * 86400)
    assert pack(visit) == today
    assert b"undo_until" not in today.content


def test_nobody_is_sent_while_somebody_is_examined(shelf: Shelf) -> None:
    shelf.finished()
    idle = [False]
    van = Van()
    mine = sender(shelf, van, lambda: idle[0])
    assert not mine.step()
    idle[0] = True
    van.errors = [Busy("somebody is examined")]
    assert not mine.step()
    assert (van.tried, shelf.outbox.waiting()[0].tries, mine.wait_s) == (1, 0, 0), "that is no failure"
    assert mine.step()


def test_a_parcel_under_way_waits_for_an_exam_and_gives_up_when_it_is_long(shelf: Shelf) -> None:
    shelf.finished()
    looks = iter([True, *[False] * 3, True])
    mine = sender(shelf, Van(), lambda: next(looks))
    assert mine.step()
    shelf.finished()
    looks = iter([True])

    def never() -> bool:
        shelf.clock.sleep(5)
        return next(looks, False)

    mine = sender(shelf, Van(), never)
    assert not mine.step()
    assert shelf.outbox.waiting()[0].tries == 0


@given(st.integers(1, 9), st.floats(0, 1))
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_tries_are_put_off_twice_as_long_each_time_up_to_an_hour(shelf: Shelf, fails: int, luck: float) -> None:
    if not shelf.waits():
        shelf.finished()
    van = Van([LINK] * fails)
    mine = Sender(shelf.outbox, packer(shelf.store, shelf.people), van, lambda: True, shelf.clock, chance=lambda: luck)
    for number in range(fails):
        assert mine.step()
        longest_s = min(FIRST_S * 2**number, LAST_S)
        assert 0.8 * longest_s <= mine.wait_s <= longest_s
        shelf.clock.sleep(mine.wait_s - 0.5)
        assert not mine.step()
        shelf.clock.sleep(0.6)
    assert mine.step(), "and when the link is back it is sent"
    assert len(van.brought) == 1
    shelf.finished()
    van.errors = [LINK]
    mine.step()
    assert mine.wait_s <= FIRST_S, "after a success the waits begin anew"
    shelf.clock.sleep(FIRST_S)
    mine.step()


def test_a_link_that_fails_is_told_of_everybody_who_waits(shelf: Shelf) -> None:
    for _ in range(3):
        shelf.finished()
    van = Van([LINK])
    mine = sender(shelf, van)
    assert mine.standing() == {}, "who waits his turn is no news"
    mine.step()
    assert van.tried == 1, "one asks for all"
    assert mine.standing() == {"send.waiting": {"n": 3}}
    shelf.clock.sleep(PATIENCE.total_seconds() - 60)
    assert mine.standing() == {"send.waiting": {"n": 3}}
    shelf.clock.sleep(120)
    assert mine.standing() == {"send.stuck": {"n": 3, "date": "2026-03-01"}}
    for _ in range(3):
        assert mine.step()
    assert mine.standing() == {}


@pytest.mark.parametrize("kind", [SendUntrusted, SendLocked])
def test_a_shut_door_is_for_a_person_at_once_and_tried_again_all_the_same(
    shelf: Shelf, kind: type[DiffuscopeError]
) -> None:
    for _ in range(2):
        shelf.finished()
    van = Van([kind("no"), kind("no")])
    mine = sender(shelf, van)
    mine.step()
    assert mine.standing() == {"send.stuck": {"n": 2, "date": "2026-03-01"}}
    shelf.clock.sleep(FIRST_S)
    assert mine.step()
    shelf.clock.sleep(2 * FIRST_S)
    while mine.step():
        pass
    assert mine.standing() == {}
    assert len(van.brought) == 2


@pytest.mark.parametrize("kind", [SendRejected, SendUnlike])
def test_one_that_is_refused_is_parked_and_keeps_nobody_else(shelf: Shelf, kind: type[DiffuscopeError]) -> None:
    refused, other = shelf.finished(), shelf.finished()
    van = Van([kind("not this one")])
    mine = sender(shelf, van)
    while mine.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in van.brought] == [other]
    shelf.clock.sleep(30 * 86400)
    assert not mine.step(), "it would be refused again"
    assert mine.standing()["send.stuck"]["n"] == 1
    said = shelf.outbox.waiting()[0]
    assert (said.visit, said.error, said.said) == (refused, kind.code, "not this one")
    mine.try_now("somebody-else")
    assert not mine.step()
    mine.try_now(refused)
    assert mine.standing() == {}
    assert mine.step()
    assert shelf.waits() == []


def test_one_whose_picture_is_damaged_keeps_nobody_else(shelf: Shelf) -> None:
    damaged = shelf.begin()
    shelf.take(damaged)
    shelf.finish(damaged)
    other = shelf.finished()
    (picture,) = (shelf.store.folder / "captures").glob("*/picture.png")
    picture.write_bytes(b"something else")
    van = Van()
    mine = sender(shelf, van)
    while mine.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in van.brought] == [other]
    assert shelf.outbox.waiting()[0].error == "store.damaged"
    assert mine.standing()["send.stuck"]["n"] == 1


def test_a_link_may_fail_for_months(shelf: Shelf) -> None:
    mine = sender(shelf, Van([LINK]))
    for _ in range(1100):  # 2.0 ** 1024 is no number
        mine._put_off()
    assert mine.wait_s == LAST_S
    shelf.clock.sleep(LAST_S)
    shelf.finished()
    assert mine.step()
    assert mine.wait_s == LAST_S


def test_one_that_is_opened_again_while_the_link_fails_is_no_trouble(shelf: Shelf) -> None:
    visit = shelf.finished()
    mine = sender(shelf, Van([LINK], between=lambda: shelf.reopen(visit)))
    assert mine.step()
    assert mine.standing() == {}
    shelf.clock.sleep(FIRST_S)
    shelf.finish(visit)
    assert shelf.outbox.waiting()[0].tries == 0


def test_try_now_does_not_wait(shelf: Shelf) -> None:
    shelf.finished()
    mine = sender(shelf, Van([LINK]))
    mine.step()
    assert not mine.step()
    mine.try_now()
    assert mine.step()
    assert shelf.waits() == []


def test_what_was_learnt_outlives_a_restart_but_no_wait_does(shelf: Shelf) -> None:
    shelf.finished()
    sender(shelf, Van([LINK])).step()
    shelf.clock.sleep(PATIENCE.total_seconds() + 1)
    again = sender(shelf, Van())
    assert again.standing() == {"send.stuck": {"n": 1, "date": "2026-03-01"}}
    assert again.wait_s == 0
    assert again.step()


def test_the_thread_sends_and_ends(shelf: Shelf) -> None:
    for _ in range(3):
        shelf.finished()
    van = Van()
    mine = sender(shelf, van)
    mine.begin()
    mine.try_now()
    mine.close()
    assert van.aborted
    mine.begin()
    end = datetime.now(UTC) + timedelta(seconds=20)
    while shelf.outbox.trouble().waiting:
        assert datetime.now(UTC) < end
    mine.close()
    assert len(van.brought) >= 3


moves = st.lists(
    st.sampled_from(["begin", "take", "finish", "reopen", "send", "fail", "lose", "refuse", "try"]), max_size=25
)


@given(moves)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_happens_each_finish_arrives_as_it_is(story: list[str]) -> None:
    """The receiver ends up with every finished visit as it was finished last, and nothing is there twice."""
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        Store(Path(folder), reserve_bytes=0) as store,
    ):
        shelf, van = Shelf(store, VirtualClock(datetime(2026, 3, 1, tzinfo=UTC))), Van()
        mine = sender(shelf, van)
        for move in story:
            play(shelf, van, mine, move)
        van.errors = []
        mine.try_now()
        while mine.step():
            pass
        pack, kept = packer(store, shelf.people), {parcel.name: parcel for parcel in van.brought}
        done = [visit.id for visit in shelf.people.visits(100, open=False)]
        assert {pack(id).name for id in done} <= kept.keys()
        assert shelf.waits() == []
        assert mine.standing() == {}


def play(shelf: Shelf, van: Van, mine: Sender, move: str) -> None:
    opened = shelf.people.visits(1, open=True)
    closed = shelf.people.visits(1, open=False)
    errors = {"fail": LINK, "refuse": SendRejected("no")}
    if move == "begin":
        shelf.begin()
    elif move in ("take", "finish") and opened:
        getattr(shelf, move)(opened[0].id)
    elif move == "reopen" and closed:
        shelf.reopen(closed[0].id)
    elif move in errors:
        van.errors = [errors[move]]
        mine.step()
        van.errors = []
        shelf.clock.sleep(60)
    elif move == "lose" and shelf.waits():  # it arrived, and nobody heard
        van.brought.append(packer(shelf.store, shelf.people)(shelf.waits()[0]))
        shelf.outbox.failed(shelf.outbox.waiting(1), LINK)
    elif move == "try":
        mine.try_now()
    elif move == "send":
        mine.step()
