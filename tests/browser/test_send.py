"""Upload queue: counts on Home, errors and retry on the Send screen."""

import re
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Instruments, Real
from tests.browser.upload_queue import Queue, queued
from tests.browser.walk import Open, after_debounce, tap
from tests.journey.conftest import until

pytestmark = pytest.mark.browser


@pytest.fixture
def queue(instruments: Instruments, undo: ExitStack) -> Queue:
    return undo.enter_context(queued(instruments))


@pytest.fixture(scope="module")
def unchanged_queue(instruments: Instruments) -> Iterator[Queue]:
    """A queue for tests that change nothing."""
    with queued(instruments) as queue:
        yield queue


def queue_items(page: Page) -> list[str]:
    page.wait_for_selector(".send .people li")
    return [re.sub(r"\s+", " ", line) for line in page.locator(".send .people li").all_inner_texts()]


def test_home_links_to_upload_queue(open_page: Open, queue: Queue) -> None:
    page = open_page(queue.url)
    expect(page.locator("#send")).to_have_text(re.compile(r"0 sent · 3 waiting"))
    tap(page, "#send")
    items = queue_items(page)
    assert ["does not take it" in item for item in items] == [True, False, False]
    assert ["tried again automatically" in item for item in items] == [False, True, False]
    assert all(re.search(r"\d MB", item) for item in items)
    assert ["1 try" in item for item in items] == [True, True, False]
    expect(page.locator(".send [aria-live]")).to_contain_text("Pictures of 3 patients wait to be sent.")
    expect(page.locator(".send [aria-live]")).to_contain_text("Next try in 1 minute.")
    queue.receiver.gate.clear()
    tap(page, "#try-now")
    expect(page.locator(".send [aria-live]")).to_contain_text("sent when no patient is being examined")
    after_debounce(page).locator(f"[data-visit='{queue.visits[0]}']").tap()
    page.wait_for_selector(".pictures")
    tap(page, "#back")
    page.wait_for_selector(".send .people li")
    page.reload()
    page.wait_for_selector(".send .people li")
    queue.receiver.answers = {}
    queue.receiver.gate.set()
    expect(page.locator(".send [aria-live]")).to_contain_text("Nothing waits to be sent.")
    expect(page.locator("#try-now")).to_have_count(0)
    assert len(queue.receiver.kept) == 3


def test_upload_alert_buttons(open_page: Open, queue: Queue) -> None:
    page = open_page(queue.url)
    page.wait_for_selector("#new")
    for code, button in (("send.waiting", "see"), ("send.stuck", "why")):
        tap(page, f"[data-code='{code}'] [data-do={button}]")
        page.wait_for_selector(".send .people li")
        tap(page, "#back")
        page.wait_for_selector("#new")
    queue.receiver.answers = {}
    tap(page, "[data-code='send.stuck'] [data-do=tryNow]")
    expect(page.locator("[data-code='send.stuck']")).to_have_count(0)
    until(lambda: len(queue.receiver.kept) == 3)


def test_other_screens_mention_automatic_upload(open_page: Open, unchanged_queue: Queue) -> None:
    queue = unchanged_queue
    page = open_page(f"{queue.url}/#/visit/{queue.visits[0]}/outcome")
    expect(page.locator("#by-itself")).to_have_text("The pictures are sent automatically.")
    page.goto(f"{queue.url}/#/history")
    tap(page, ".history [data-value=waiting]")
    assert len(queue_items(page)) == 3


def test_upload_texts_are_hidden_without_receiver(open_page: Open, real: Real) -> None:
    visit = real.begin_visit()
    real.finish(visit["id"])
    page = open_page(real.url)
    page.wait_for_selector(".day")
    expect(page.locator(".space")).to_be_visible()  # the status is loaded
    expect(page.locator("#send")).to_have_count(0)
    page.goto(f"{real.url}/#/visit/{visit['id']}/outcome")
    page.wait_for_selector("#done")
    expect(page.locator("#by-itself")).to_have_count(0)
    page.goto(f"{real.url}/#/history")
    page.wait_for_selector(".history [data-value=referred]")
    expect(page.locator(".history [data-value=waiting]")).to_have_count(0)
    page.goto(f"{real.url}/#/send")
    expect(page.locator(".send .verdict")).to_contain_text("Nothing is sent from this device.")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("language", ["en-XA", "ta"])
def test_send_screen_layout_and_axe(open_page: Open, unchanged_queue: Queue, size: str, language: str) -> None:
    page = open_page("about:blank", SIZES[size])
    page.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")
    for place, mark in (("", "#send"), ("send", ".send .people li")):
        page.goto(f"{unchanged_queue.url}/#/{place}")
        page.wait_for_selector(mark)
        assert look_for_faults(page) == []
        assert axe_faults(page) == []
