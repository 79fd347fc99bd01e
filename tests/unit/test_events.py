"""Event bus: subscribers with independent positions, publication from any thread, close."""

import asyncio
import json
from collections.abc import Callable
from contextlib import aclosing
from threading import Thread

import pytest

from services.http.routes.events import sse_text
from services.instrument.events import BUFFER_LENGTH, Event, EventBus


async def read(event_bus: EventBus, count: int, after: int | None = None, begin: Callable[[], None] = lambda: None):
    received: list[Event] = []
    async with aclosing(event_bus.subscribe(after)) as subscription:
        async for event in subscription:
            if not received:
                begin()
            received.append(event)
            if len(received) == count:
                break
    return received


def test_a_subscriber_receives_later_events_in_order() -> None:
    event_bus = EventBus()
    event_bus.publish("before")

    def publish_from_threads() -> None:
        for n in range(20):
            publisher = Thread(target=event_bus.publish, args=("news",), kwargs={"n": n})
            publisher.start()
            publisher.join()

    received = asyncio.run(read(event_bus, 21, begin=publish_from_threads))
    assert received[0] == Event(0, "beat", {"number": 1})
    assert [event.data["n"] for event in received[1:]] == list(range(20))
    assert [event.number for event in received[1:]] == list(range(2, 22))


def test_two_subscribers_receive_the_same_events() -> None:
    event_bus = EventBus()

    async def subscription():
        tasks = [asyncio.create_task(read(event_bus, 3)) for _ in range(2)]
        await asyncio.sleep(0.05)
        event_bus.publish("one")
        event_bus.publish("two")
        return await asyncio.gather(*tasks)

    first, second = asyncio.run(subscription())
    assert first == second
    assert [event.kind for event in first] == ["beat", "one", "two"]


@pytest.mark.parametrize(("after", "numbers"), [(0, [1, 2, 3]), (2, [3]), (99, [1, 2, 3])])
def test_a_reconnected_subscriber_receives_missed_events(after: int, numbers: list[int]) -> None:
    event_bus = EventBus()
    for kind in "abc":
        event_bus.publish(kind)
    received = asyncio.run(read(event_bus, 1 + len(numbers), after))
    assert [event.number for event in received[1:]] == numbers


def test_the_ring_buffer_drops_the_oldest_events() -> None:
    event_bus = EventBus()
    for _ in range(BUFFER_LENGTH + 50):
        event_bus.publish("news")
    received = asyncio.run(read(event_bus, 1 + BUFFER_LENGTH, after=0))
    assert [event.number for event in received[1:]] == list(range(51, BUFFER_LENGTH + 51))


def test_close_ends_waiting_and_later_subscribers() -> None:
    event_bus = EventBus()
    waiting = asyncio.run(read(event_bus, 100, begin=event_bus.close))
    late = asyncio.run(read(event_bus, 100))
    assert [event.kind for event in waiting] == [event.kind for event in late] == ["beat"]


def test_a_subscriber_with_a_closed_loop_does_not_disturb_publish() -> None:
    event_bus = EventBus()
    asyncio.run(read(event_bus, 1))  # the event loop of the subscriber is closed now
    event_bus.publish("news")
    assert event_bus.last_number == 1


def test_an_event_is_formatted_as_a_server_sent_event() -> None:
    text = sse_text(Event(7, "accuracy", {"progress": "a\nb: ä"}))
    assert text.endswith("\n\n")
    fields = dict(line.split(": ", 1) for line in text.strip().split("\n"))
    assert (fields["id"], fields["event"]) == ("7", "accuracy")
    assert json.loads(fields["data"]) == {"progress": "a\nb: ä"}
    assert "id:" not in sse_text(Event(0, "beat", {"number": 3}))
