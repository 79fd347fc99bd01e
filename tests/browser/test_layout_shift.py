"""Layout stability, labels of pictures and visits, and navigation back."""

import pytest
from playwright.sync_api import Page, Route, expect

from tests.browser.alert_causes import CAUSES
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Real
from tests.browser.walk import SHUTTER, Open, aiming, set_language, stay, take_picture, tap, visit_of

pytestmark = pytest.mark.browser

FIRST = "A0001-3"  # without letters of a device: this instrument has no identity
OPEN_FIRST = f"Open {FIRST}"


def boxes(page: Page, *selectors: str) -> dict[str, object]:
    """Return the bounding boxes of these elements in pixels."""
    return {selector: page.locator(selector).first.bounding_box() for selector in selectors}


@pytest.mark.parametrize("language", ["en", "ta"])
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_no_layout_shift_during_capture(open_page: Open, real: Real, size: tuple[int, int], language: str) -> None:
    real.hold = "quick"
    page = aiming(open_page, real, size)
    set_language(page, language)
    page.reload()
    tap(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=assessed] .stage[data-mark=quick]")
    moving = (".stage", ".card", ".tools", ".tiles", ".actions")
    before = boxes(page, *moving)
    value = page.locator("progress").evaluate("bar => bar.value")
    real.hold = "stored"
    expect(page.locator("progress")).not_to_have_js_property("value", value)
    assert boxes(page, *moving) == before
    real.hold = None
    page.wait_for_selector("[data-phase=kept]")
    assert boxes(page, *moving) == before
    page.wait_for_selector(".stage[data-mark=final]")
    assert boxes(page, *moving) == before
    tap(page, "#open-details")
    assert boxes(page, *moving) == before
    assert look_for_faults(page) == []


@pytest.mark.parametrize(
    "size", [SIZES["tablet"], SIZES["portrait"], SIZES["phone"]], ids=["tablet", "portrait", "phone"]
)
def test_a_message_moves_no_button(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    """A tap meant for Next ended a visit: a message had moved Finish there."""
    page = aiming(open_page, real, size)

    def assert_still(codes: tuple[str, ...], *buttons: str) -> None:
        before = boxes(page, *buttons)
        for code in codes:
            end = CAUSES[code](real, "")
            expect(page.locator(f"[data-code='{code}']")).to_be_visible(timeout=15_000)
            assert boxes(page, *buttons) == before, code
            if page.locator("[data-screen=picture]").count():
                expect(page.locator(".prompt .title")).to_have_text("Right eye · Macula")  # no alert in its place
            end()
            expect(page.locator(f"[data-code='{code}']")).to_have_count(0)

    assert_still(("store.low", "batt.empty"), "[data-slot='R-centre']", ".actions", "#not-possible", "#finish")
    take_picture(page)
    expect(page.locator("#result-title")).to_have_text("Good")
    expect(page.locator("[data-code='make.slow']")).to_have_count(0)  # the card says that the worker can go on
    assert_still(("heat.warm", "batt.empty"), "[data-slot='R-centre']", "#again", "#next", "#finish")
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/patient")
    page.wait_for_selector(".patient .asking")
    assert_still(("heat.warm", "batt.empty"), "[data-value=agreed]", "#shoot", "#pictures")
    page.goto(real.url)
    page.wait_for_selector("#continue")
    assert_still(("heat.warm", "batt.empty"), "#new", "#continue", "#find")


def test_result_shows_slot_label_and_one_go_on_text(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, SIZES["phone"])
    take_picture(page)
    expect(page.locator(".prompt")).to_contain_text("Right eye · Macula")
    assert page.locator("main").inner_text().count("Sharp and bright enough") == 1
    expect(page.get_by_role("button", name="Colour")).to_have_attribute("aria-pressed", "true")


def test_previous_picture_is_kept_and_back_leads_home(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    expect(page.locator("#keep-old")).to_have_count(0)
    for slot in ("R-centre", "R-nerve"):
        take_picture(page)
        tap(page, "#next")
        page.wait_for_selector(f"[data-slot='{slot}'][data-face=good]")
    tap(page, "[data-slot='R-centre']")
    tap(page, "#again")
    tap(page, "#keep-old")
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    assert real.presses == 2
    tap(page, "#back")
    page.wait_for_selector("[data-screen=patient]")
    tap(page, "#back")
    page.wait_for_selector("#new")


def test_find_opens_an_exact_match_only_and_reports_no_match(open_page: Open, real: Real) -> None:
    real.begin_visit(consent="agreed")
    page = open_page(f"{real.url}/#/find")
    pad = page.locator(".pad")
    where = pad.bounding_box()
    for digit in "0013":
        page.locator(f"[data-key='{digit}']").tap()
    expect(page.get_by_text("Choose the patient in the list.")).to_be_visible()
    expect(page.locator(".people li")).to_have_count(1)
    expect(page.locator("#open-found, .find .primary")).to_have_count(0)  # 0013 is a part of the number only
    page.locator("[data-key='9']").tap()
    expect(page.get_by_text("No patient with 00139.")).to_be_visible()
    assert pad.bounding_box() == where
    for _ in range(5):
        page.locator("[data-key='erase']").tap()
    page.keyboard.type("A00013")
    expect(page.locator("#open-found")).to_have_text(OPEN_FIRST)
    expect(page.locator("#open-found")).to_have_class("primary")
    expect(page.locator("#start")).not_to_have_class("primary")
    page.locator("#open-found").tap()
    page.wait_for_selector("[data-screen=aim]")
    assert len(real.visits()) == 1


def test_scanned_number_opens_visit(open_page: Open, real: Real) -> None:
    """Also the visit of an earlier day, with the Enter of a code reader before the list of its number is there."""
    real.begin_visit(consent="agreed")
    page = open_page("about:blank")
    page.route("**/api/visits?day=*", lambda route: route.fulfill(json={"visits": [], "counts": None}))
    page.goto(f"{real.url}/#/find")
    page.wait_for_selector(".find")
    page.keyboard.type(real.visits()[0]["number"])
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-screen=aim]")
    assert len(real.visits()) == 1


def test_number_with_check_digit_is_found_in_both_forms(open_page: Open, real: Real) -> None:
    real.begin_visit(consent="agreed")
    real.begin_visit(number="SELF-7", consent="agreed")
    page = open_page(f"{real.url}/#/find")
    expect(page.locator(".people")).to_contain_text(FIRST)
    expect(page.locator(".people")).to_contain_text("SELF-7")
    page.locator("[data-key='1']").tap()
    expect(page.locator(".people")).not_to_contain_text("SELF-7")
    expect(page.locator(".people")).to_contain_text(FIRST)
    page.locator("[data-key='3']").tap()
    expect(page.locator(".people")).to_contain_text(FIRST)
    page.locator("[data-key='erase']").tap()
    page.locator("[data-key='erase']").tap()
    page.keyboard.type(FIRST)
    page.locator("#open-found").tap()
    expect(page.locator("h1")).to_contain_text(FIRST)


def test_no_layout_shift_from_form_input(open_page: Open, real: Real) -> None:
    visit = real.begin_visit()
    page = open_page(f"{real.url}/#/visit/{visit['id']}/patient", SIZES["portrait"])
    page.wait_for_selector(".asking")
    chips = [f"[data-value={value}]" for value in ("agreed", "declined", "woman", "man", "flashes", "red")]
    before = boxes(page, *chips, ".question .pad", "[data-field=diabetes]")
    unanswered: list[Route] = []
    page.route(f"**/api/visits/{visit['id']}", lambda route: unanswered.append(route))  # the answers stay unsaved
    for selector in ("[data-value=declined]", "[data-value=woman]", "[data-value=flashes]", "[data-key='5']"):
        page.locator(selector).tap()
    expect(page.locator(".question output")).to_have_text("5")
    expect(page.locator("#unsaved")).not_to_be_empty()
    assert boxes(page, *chips, ".question .pad", "[data-field=diabetes]") == before


def test_compared_pictures_are_labelled(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    for _ in range(2):
        take_picture(page)
        tap(page, "#again")
    visit = real.visit()
    first, second = visit["slots"]["R-centre"]["captures"]
    page.goto(f"{real.url}/#/visit/{visit['id']}/compare/{first}/{second}")
    left, right = (page.locator(".two figcaption").nth(index) for index in (0, 1))
    for caption, name in ((left, "picture 1"), (right, "picture 2")):
        expect(caption).to_contain_text(f"Right eye · Macula, {name}")
        expect(caption).to_contain_text(":")  # the time of day
    expect(right).to_contain_text("Used")
    expect(left).not_to_contain_text("Used")
    page.get_by_role("button", name="Switch between the two").tap()
    page.get_by_role("button", name="Show Right eye · Macula, picture 2").tap()
    expect(right).to_be_visible()
    expect(left).to_be_hidden()
    expect(page.locator("#swap")).to_contain_text("picture 1")
