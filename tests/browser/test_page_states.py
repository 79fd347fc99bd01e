"""States that are rare on the real server, held still by the stand-in; and the page's looks at four sizes."""

import re
import time
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Complaints
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, double_tap, drawn, new_person, settled, taken

pytestmark = pytest.mark.browser

BUSY = {
    "code": "busy",
    "message": "The instrument is taking another picture.",
    "remedy": "A picture is being taken. Wait until it is done, then press again.",
}


def zoom(page: Page) -> float:
    return float(page.locator("#picture").get_attribute("data-zoom") or 0)


def middle_pixel(page: Page, dx: float = 0.0) -> list[int]:
    """The RGB value drawn in the viewer, `dx` picture heights right of the middle."""
    script = """dx => {
        const c = document.querySelector("#picture canvas");
        const { data } = c.getContext("2d").getImageData(c.width / 2 + dx * c.height, c.height / 2, 1, 1);
        return [...data].slice(0, 3);
    }"""
    value: list[int] = page.evaluate(script, dx)
    return value


def test_a_sharper_picture_replaces_the_quick_look_and_keeps_the_view(open_page: Open, stub: Stubbed) -> None:
    stub.stub.hold = "verdict"
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    page.wait_for_selector(".stage[data-mark=quick]")
    expect(page.get_by_role("status")).to_contain_text("Quick look")
    bar = page.locator("progress").evaluate("bar => bar.value")
    page.get_by_role("button", name="Red-free").tap()
    page.get_by_role("button", name="Zoom in").tap()
    page.get_by_role("button", name="Zoom in").tap()
    assert zoom(page) == 2.25
    assert page.locator(".stage").get_attribute("data-mark") == "quick"
    stub.stub.hold = "keep"
    page.wait_for_selector("[data-phase=told]")
    page.wait_for_timeout(300)
    assert page.locator("progress").evaluate("bar => bar.value") > bar
    stub.stub.hold = None
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.get_by_role("status")).to_contain_text("Final picture, kept")
    assert zoom(page) == 2.25
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "true")


def test_red_free_and_contrast_change_what_is_drawn(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    drawn(page, "colour 0 0")
    red, green, blue = middle_pixel(page)
    assert red > green > blue
    page.keyboard.press("g")
    drawn(page, "red-free 0 0")
    assert middle_pixel(page) == [green] * 3
    bright = middle_pixel(page, 0.235)[0]
    page.keyboard.press("+")
    drawn(page, "red-free 0 1")
    assert middle_pixel(page, 0.235)[0] > bright, "more contrast makes the bright nerve head brighter"
    expect(page.get_by_text("Contrast +1")).to_be_visible()
    page.keyboard.press("0")
    drawn(page, "red-free 0 0")
    assert middle_pixel(page) == [green] * 3


def test_fingers_wheel_and_keys_zoom_between_one_and_eight(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    box = page.locator("#picture").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *xs: float) -> None:
        points: list[dict[str, Any]] = [{"x": at, "y": y, "id": i} for i, at in enumerate(xs)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", x - 50, x + 50)
    for spread in (70, 90, 110, 150):
        fingers("touchMove", x - spread, x + spread)
    fingers("touchEnd")
    assert zoom(page) == pytest.approx(3, rel=0.05)
    double_tap(page, x + 40, y)
    assert zoom(page) == 1
    double_tap(page, x + 40, y)
    assert zoom(page) == 3
    page.mouse.move(x, y)
    for _ in range(20):
        page.mouse.wheel(0, -200)
    expect(page.locator("#picture")).to_have_attribute("data-zoom", "8.00")
    page.locator("#picture").focus()
    page.keyboard.press("ArrowLeft")
    for _ in range(12):
        page.keyboard.press("-")
    assert zoom(page) == 1
    page.keyboard.press("+")
    assert zoom(page) == 1.5
    page.keyboard.press("0")
    assert zoom(page) == 1


def test_a_refusal_is_shown_in_the_instruments_own_words(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("409")
    stub.stub.refuse = (409, BUSY)
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    bar = page.get_by_role("status")
    expect(bar).to_contain_text(BUSY["message"])
    expect(bar).to_contain_text(BUSY["remedy"])
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    stub.stub.refuse = None
    taken(page)
    expect(page.locator(".state-bar")).to_have_count(0)


def test_an_impatient_second_press_costs_the_eye_nothing(open_page: Open, stub: Stubbed) -> None:
    stub.stub.hold = "verdict"
    page = aiming(open_page, stub)
    page.locator(SHUTTER).dblclick()
    settled(page).locator(SHUTTER).tap(force=True)
    expect(page.get_by_role("status")).to_contain_text("still being made")
    stub.stub.hold = None
    page.wait_for_selector(".stage[data-mark=final]")
    assert stub.stub.presses == 1


def test_a_double_tap_on_next_takes_no_picture(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    box = settled(page).locator("#next").bounding_box()
    assert box is not None
    for _ in range(2):
        page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator(SHUTTER)).to_contain_text("Nerve")
    page.wait_for_timeout(300)
    assert stub.stub.presses == 1


def test_a_double_tap_on_new_person_makes_one_person(open_page: Open, stub: Stubbed) -> None:
    page = settled(open_page(stub.url))
    page.locator("#new").dblclick()
    page.wait_for_selector(".person")
    page.wait_for_timeout(300)
    assert len(stub.stub.visits.kept) == 1


def test_an_answer_without_words_still_says_what_to_do(open_page: Open, stub: Stubbed, complaints: Complaints) -> None:
    complaints.expect("500")
    stub.stub.refuse = (500, {})
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    expect(page.get_by_role("status")).to_contain_text("try again")


def test_a_recording_is_marked_on_every_screen(open_page: Open, stub: Stubbed) -> None:
    stub.stub.kind = "recording"
    page = open_page(stub.url)
    expect(page.locator("header .chip")).to_have_text("RECORDING")
    new_person(page)
    expect(page.locator("header .chip")).to_have_text("RECORDING")


def test_an_old_live_picture_says_its_age(open_page: Open, stub: Stubbed) -> None:
    stub.stub.preview_age_ms = 2400
    page = aiming(open_page, stub)
    expect(page.locator("eye-live .age")).to_have_text(re.compile(r"^2\.\d s old$"))
    expect(page.locator("[data-code='link.slow']")).to_contain_text("2 s late")
    stub.stub.preview_age_ms = 40
    expect(page.locator("eye-live .age")).to_be_hidden()
    expect(page.locator("[data-code='link.slow']")).to_have_count(0)


def test_warnings_about_a_picture_are_shown_with_it(open_page: Open, stub: Stubbed) -> None:
    stub.stub.warnings = ["The frame was partly saturated."]
    page = aiming(open_page, stub)
    taken(page)
    page.get_by_role("button", name="Details: with a warning").tap()
    expect(page.locator("#details")).to_contain_text("partly saturated")


def test_silence_is_a_lost_link_and_the_shutter_says_so(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    expect(page.locator(".state")).to_have_text("Ready")
    stub.stub.silent = True
    began = time.monotonic()
    expect(page.get_by_role("alert")).to_contain_text("Trying again", timeout=6000)
    assert 2 < time.monotonic() - began < 5
    expect(page.locator(SHUTTER)).to_contain_text("No link")
    page.locator(SHUTTER).tap(force=True)
    page.wait_for_timeout(200)
    assert stub.stub.presses == 0, "a press into a dead link must not fire later"
    stub.stub.silent = False
    expect(page.get_by_role("alert")).to_have_count(0, timeout=3000)


def test_the_theme_is_chosen_in_the_menu_and_remembered(open_page: Open, stub: Stubbed) -> None:
    page = open_page(stub.url)
    expect(page.locator("html")).to_have_attribute("data-theme", "dim")
    page.get_by_role("button", name="Menu").tap()
    page.get_by_role("button", name="Daylight").tap()
    page.get_by_role("button", name="Close").tap()
    page.reload()
    expect(page.locator("html")).to_have_attribute("data-theme", "daylight")


def test_letter_keys_can_be_switched_off(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    page.get_by_role("button", name="Menu").tap()
    page.get_by_text("Keys", exact=True).tap()
    page.locator("#letters").uncheck()
    page.get_by_role("button", name="Close").tap()
    taken(page)
    page.keyboard.press("g")
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "false")


def test_a_screen_that_a_broken_link_kept_back_comes_when_it_is_asked_for_again(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("ERR_FAILED")
    page = open_page(stub.url)
    page.wait_for_selector("#new")
    page.route("**/screens/history.js", lambda route: route.abort())
    with page.expect_event("requestfailed"):
        settled(page).locator("#history").tap()
    page.unroute("**/screens/history.js")
    settled(page).locator("#back").tap()
    settled(page).locator("#history").tap()
    page.wait_for_selector(".history")


def test_motion_is_left_out_where_it_is_not_wanted(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub, reduced_motion="reduce")
    assert page.locator(SHUTTER).evaluate("b => getComputedStyle(b).transitionDuration") == "0s"
    taken(page)
