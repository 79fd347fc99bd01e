"""The board on which the instrument writes: every reader at its own pace, from any thread, and an end."""

import asyncio
import json
from collections.abc import Callable
from threading import Thread

import pytest

from services.instrument.bulletin import RING, Bulletin, Event


async def read(bulletin: Bulletin, count: int, after: int | None = None, begin: Callable[[], None] = lambda: None):
    heard: list[Event] = []
    story = bulletin.follow(after)
    async for event in story:
        if not heard:
            begin()
        heard.append(event)
        if len(heard) == count:
            break
    await story.aclose()
    return heard


def test_a_reader_hears_what_is_told_after_it_came_in_order() -> None:
    bulletin = Bulletin()
    bulletin.tell("before")

    def tell_from_threads() -> None:
        for n in range(20):
            teller = Thread(target=bulletin.tell, args=("news",), kwargs={"n": n})
            teller.start()
            teller.join()

    heard = asyncio.run(read(bulletin, 21, begin=tell_from_threads))
    assert heard[0] == Event(0, "beat", {"number": 1})
    assert [event.data["n"] for event in heard[1:]] == list(range(20))
    assert [event.number for event in heard[1:]] == list(range(2, 22))


def test_two_readers_hear_the_same() -> None:
    bulletin = Bulletin()

    async def story():
        readers = [asyncio.create_task(read(bulletin, 3)) for _ in range(2)]
        await asyncio.sleep(0.05)
        bulletin.tell("one")
        bulletin.tell("two")
        return await asyncio.gather(*readers)

    first, second = asyncio.run(story())
    assert first == second
    assert [event.kind for event in first] == ["beat", "one", "two"]


@pytest.mark.parametrize(("after", "numbers"), [(0, [1, 2, 3]), (2, [3]), (99, [1, 2, 3])])
def test_a_reader_that_was_away_catches_up(after: int, numbers: list[int]) -> None:
    bulletin = Bulletin()
    for kind in "abc":
        bulletin.tell(kind)
    heard = asyncio.run(read(bulletin, 1 + len(numbers), after))
    assert [event.number for event in heard[1:]] == numbers


def test_the_ring_forgets_the_oldest_and_never_grows() -> None:
    bulletin = Bulletin()
    for _ in range(RING + 50):
        bulletin.tell("news")
    heard = asyncio.run(read(bulletin, 1 + RING, after=0))
    assert [event.number for event in heard[1:]] == list(range(51, RING + 51))


def test_closing_ends_a_reader_that_waits_and_one_that_comes_later() -> None:
    bulletin = Bulletin()
    waiting = asyncio.run(read(bulletin, 100, begin=bulletin.close))
    late = asyncio.run(read(bulletin, 100))
    assert [event.kind for event in waiting] == [event.kind for event in late] == ["beat"]


def test_a_reader_whose_page_went_away_does_not_disturb_the_teller() -> None:
    bulletin = Bulletin()
    asyncio.run(read(bulletin, 1))  # its loop is closed now
    bulletin.tell("news")
    assert bulletin.last_number == 1


def test_an_event_as_text_is_what_a_browser_reads() -> None:
    text = Event(7, "kept", {"note": "a\nb: ä"}).as_sse()
    assert text.endswith("\n\n")
    fields = dict(line.split(": ", 1) for line in text.strip().split("\n"))
    assert (fields["id"], fields["event"]) == ("7", "kept")
    assert json.loads(fields["data"]) == {"note": "a\nb: ä"}
    assert "id:" not in Event(0, "beat", {}).as_sse()
