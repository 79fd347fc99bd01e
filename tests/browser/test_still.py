"""Nothing jumps under a finger, every picture says what it is, and every way leads out again."""

import pytest
from playwright.sync_api import Page, expect

from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, spoken, taken, tap

pytestmark = pytest.mark.browser


def places(page: Page, *selectors: str) -> dict[str, object]:
    """Where these stand now, to the pixel."""
    return {selector: page.locator(selector).first.bounding_box() for selector in selectors}


@pytest.mark.parametrize("language", ["en", "ta"])
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_no_control_moves_while_the_picture_is_made_and_told(
    open_page: Open, stub: Stubbed, size: tuple[int, int], language: str
) -> None:
    stub.stub.hold = "verdict"
    page = aiming(open_page, stub, size)
    spoken(page, language)
    page.reload()
    tap(page, SHUTTER)
    page.wait_for_selector(".stage[data-mark=quick]")
    moving = (".stage", ".card", ".tools", ".tiles", ".actions")
    before = places(page, *moving)
    for hold, phase in (("keep", "told"), (None, "kept")):
        stub.stub.hold = hold
        page.wait_for_selector(f"[data-phase={phase}]")
        assert places(page, *moving) == before
    page.wait_for_selector(".stage[data-mark=final]")
    assert places(page, *moving) == before
    tap(page, "#open-details")
    assert places(page, *moving) == before
    assert look_for_faults(page) == []


def test_the_result_keeps_the_name_of_its_picture_and_says_once_that_one_can_go_on(
    open_page: Open, stub: Stubbed
) -> None:
    page = aiming(open_page, stub, SIZES["phone"])
    taken(page)
    expect(page.locator(".prompt")).to_contain_text("Right eye · Centre")
    assert page.locator("main").inner_text().count("You can go on") == 1
    expect(page.get_by_role("button", name="As taken")).to_have_attribute("aria-pressed", "true")


def test_an_old_picture_is_kept_and_two_steps_back_lead_home(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    expect(page.locator("#keep-old")).to_have_count(0)
    for slot in ("R-centre", "R-nerve"):
        taken(page)
        tap(page, "#next")
        page.wait_for_selector(f"[data-slot='{slot}'][data-face=good]")
    tap(page, "[data-slot='R-centre']")
    tap(page, "#again")
    tap(page, "#keep-old")
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    assert stub.stub.presses == 2
    tap(page, "#back")
    page.wait_for_selector("[data-screen=person]")
    tap(page, "#back")
    page.wait_for_selector("#new")


def test_whoever_is_found_comes_first_and_nobody_is_said_in_words(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin(consent="agreed")
    page = open_page(f"{stub.url}/#/find")
    pad = page.locator(".pad")
    where = pad.bounding_box()
    for digit in "142":
        page.locator(f"[data-key='{digit}']").tap()
    expect(page.locator("#open-found")).to_have_text("Open A0142")
    expect(page.locator("#open-found")).to_have_class("primary")
    expect(page.locator("#start")).not_to_have_class("primary")
    page.locator("[data-key='9']").tap()
    expect(page.get_by_text("No match for 1429.")).to_be_visible()
    assert pad.bounding_box() == where
    page.locator("[data-key='erase']").tap()
    page.locator("#open-found").tap()
    page.wait_for_selector("[data-screen=aim]")
    assert len(stub.stub.visits.kept) == 1


def test_a_code_that_is_read_opens_whoever_has_that_number(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin(consent="agreed")
    page = open_page(f"{stub.url}/#/find")
    page.wait_for_selector(".people")
    page.keyboard.type("A0142")
    page.wait_for_selector("#open-found")
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-screen=aim]")
    assert len(stub.stub.visits.kept) == 1


def test_a_number_has_its_check_digit_apart_and_is_found_in_both_forms(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin(number="A00013", consent="agreed")
    stub.stub.visits.begin(number="SELF-7", consent="agreed")
    page = open_page(f"{stub.url}/#/find")
    expect(page.locator(".people")).to_contain_text("A0001-3")
    expect(page.locator(".people")).to_contain_text("SELF-7")
    page.locator("[data-key='1']").tap()
    expect(page.locator("#open-found")).to_have_text("Open A0001-3")
    page.locator("[data-key='3']").tap()
    expect(page.locator("#open-found")).to_have_text("Open A0001-3")
    page.locator("#open-found").tap()
    expect(page.locator("h1")).to_contain_text("A0001-3")


def test_neither_a_tick_nor_a_typed_age_moves_anything(open_page: Open, stub: Stubbed) -> None:
    visit = stub.stub.visits.begin()
    page = open_page(f"{stub.url}/#/visit/{visit['id']}/person", SIZES["portrait"])
    page.wait_for_selector(".asking")
    chips = [f"[data-value={value}]" for value in ("agreed", "declined", "woman", "man", "flashes", "red")]
    before = places(page, *chips, ".question .pad", "[data-field=diabetes]")
    for selector in ("[data-value=agreed]", "[data-value=woman]", "[data-value=flashes]", "[data-key='5']"):
        page.locator(selector).tap()
    expect(page.locator(".question output")).to_have_text("5")
    assert places(page, *chips, ".question .pad", "[data-field=diabetes]") == before


def test_two_pictures_that_are_compared_say_which_they_are(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    for _ in range(2):
        taken(page)
        tap(page, "#again")
    first, second = stub.stub.visits.kept["v142"]["slots"]["R-centre"]["captures"]
    page.goto(f"{stub.url}/#/visit/v142/compare/{first}/{second}")
    left, right = (page.locator(".two figcaption").nth(one) for one in (0, 1))
    for caption, name in ((left, "picture 1"), (right, "picture 2")):
        expect(caption).to_contain_text(f"Right eye · Centre, {name}")
        expect(caption).to_contain_text(":")  # the time
    expect(right).to_contain_text("Used")
    expect(left).not_to_contain_text("Used")
    page.get_by_role("button", name="One over the other").tap()
    page.get_by_role("button", name="Show Right eye · Centre, picture 2").tap()
    expect(right).to_be_visible()
    expect(left).to_be_hidden()
    expect(page.locator("#swap")).to_contain_text("picture 1")
