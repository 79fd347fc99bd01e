"""Where visits are sent by themselves: Home counts them, the Send screen says who waits and why, and tries at once."""

import re

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.stub_visits import unsent
from tests.browser.walk import Open, settled, tap

pytestmark = pytest.mark.browser


@pytest.fixture
def waiting(stub: Stubbed) -> Stubbed:
    """Three people wait: one for ever, one for the link, one for his turn."""
    stub.stub.sending = True
    for code in ("send.refused", "send.link", None):
        visit = stub.stub.visits.begin(sex="woman", age=54)
        stub.stub.visits.finish(visit)
        stub.stub.unsent.append(unsent(visit, code, 3 if code else 0))
    return stub


def lines(page: Page) -> list[str]:
    page.wait_for_selector(".send .people li")
    return [re.sub(r"\s+", " ", line) for line in page.locator(".send .people li").all_inner_texts()]


def test_home_counts_and_leads_to_who_waits_and_why(open_page: Open, waiting: Stubbed) -> None:
    page = open_page(waiting.url)
    expect(page.locator("#send")).to_have_text(re.compile(r"20 sent · 3 waiting"))
    tap(page, "#send")
    said = lines(page)
    assert ["does not take it" in one for one in said] == [True, False, False]
    assert ["tried again by itself" in one for one in said] == [False, True, False]
    assert all("8.2 MB" in one for one in said)
    assert ["3 tries" in one for one in said] == [True, True, False]
    expect(page.locator(".send [aria-live]")).to_contain_text("3 people wait to be sent.")
    expect(page.locator(".send [aria-live]")).to_contain_text("Next try in 12 minutes.")
    tap(page, "#try-now")
    expect(page.locator(".send [aria-live]")).to_contain_text("sent while nobody is examined")
    assert waiting.stub.tried == [None]
    settled(page).locator("[data-visit=v142]").tap()
    page.wait_for_selector(".film")
    tap(page, "#back")
    page.wait_for_selector(".send .people li")
    page.reload()
    page.wait_for_selector(".send .people li")
    waiting.stub.unsent.clear()
    expect(page.locator(".send [aria-live]")).to_contain_text("Nobody waits to be sent.", timeout=15_000)
    expect(page.locator("#try-now")).to_have_count(0)


def test_the_buttons_of_its_states_lead_there_and_try(open_page: Open, waiting: Stubbed) -> None:
    page = open_page(waiting.url)
    page.wait_for_selector("#new")
    for code, button in (("send.waiting", "see"), ("send.stuck", "why")):
        waiting.stub.tell("notice", {"code": code, "n": 3, "date": "2026-05-03"})
        tap(page, f"[data-code='{code}'] [data-do={button}]")
        page.wait_for_selector(".send .people li")
        tap(page, "#back")
        page.wait_for_selector("#new")
    tap(page, "[data-code='send.stuck'] [data-do=tryNow]")
    expect(page.locator("[data-code='send.stuck']")).to_have_count(0)
    assert waiting.stub.tried == [None]


def test_the_other_screens_say_that_it_happens_by_itself(open_page: Open, waiting: Stubbed) -> None:
    page = open_page(f"{waiting.url}/#/visit/v142/outcome")
    expect(page.locator("#by-itself")).to_have_text("The pictures are sent by themselves.")
    page.goto(f"{waiting.url}/#/history")
    tap(page, ".history [data-value=waiting]")
    assert len(lines(page)) == 3


def test_where_nothing_is_sent_nothing_is_said_of_it(open_page: Open, stub: Stubbed) -> None:
    visit = stub.stub.visits.begin()
    stub.stub.visits.finish(visit)
    page = open_page(stub.url)
    page.wait_for_selector(".day")
    expect(page.locator(".space")).to_be_visible()  # the status is there
    expect(page.locator("#send")).to_have_count(0)
    page.goto(f"{stub.url}/#/visit/{visit['id']}/outcome")
    page.wait_for_selector("#done")
    expect(page.locator("#by-itself")).to_have_count(0)
    page.goto(f"{stub.url}/#/history")
    page.wait_for_selector(".history [data-value=referred]")
    expect(page.locator(".history [data-value=waiting]")).to_have_count(0)
    page.goto(f"{stub.url}/#/send")
    expect(page.locator(".send .verdict")).to_contain_text("Nothing is sent from this device.")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("language", ["en-XA", "ta"])
def test_it_fits_and_axe_finds_nothing(open_page: Open, waiting: Stubbed, size: str, language: str) -> None:
    page = open_page("about:blank", SIZES[size])
    page.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")
    for place, mark in (("", "#send"), ("send", ".send .people li")):
        page.goto(f"{waiting.url}/#/{place}")
        page.wait_for_selector(mark)
        assert look_for_faults(page) == []
        assert axe_faults(page) == []
