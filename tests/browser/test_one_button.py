"""One button: the page goes on by itself to the next picture, never to the next exposure."""

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Real
from tests.browser.walk import (
    SHOWN_MS,
    SHUTTER,
    UNSEEN_MS,
    Open,
    after_debounce,
    aiming,
    expect_to_stay,
    new_person,
    take_picture,
    tap,
    wait_for_preview,
)
from tests.journey.faults import wait_until_idle

pytestmark = pytest.mark.browser

SLOTS = ["R-centre", "R-nerve", "L-centre", "L-nerve"]
TAPS_MAX = 8  # for four pictures, from the start screen
COUNT_TAPS = "taps = 0; addEventListener('pointerdown', () => { taps += 1; }, {capture: true})"
# Notes when each screen came, and presses the shutter at these times after the page has gone on.
NOTE_TIMES = """(presses) => {
  times = {};
  const push = history.pushState;
  const press = () => document.querySelector("[data-screen=aim] #shutter")?.click();
  history.pushState = function (...entry) {
    push.apply(this, entry);
    const screen = entry[2].includes("/aim/") ? "aim" : "picture";
    times[screen] = performance.now();
    if (screen === "aim") for (const ms of presses) setTimeout(press, ms);
  };
}"""
TOUCH = """(kind) => document.querySelector("#shutter").dispatchEvent(
  new PointerEvent(kind, {pointerId: 77, isPrimary: true, bubbles: true, cancelable: true, detail: 1}))"""


def press_and_go_on(page: Page, to: str) -> None:
    """Take a good picture and wait until the page aims at the next slot."""
    tap(page, SHUTTER)
    page.wait_for_selector("[data-screen=picture]")
    wait_for_aim(page, to)


def wait_for_aim(page: Page, slot: str) -> None:
    page.wait_for_selector(f"[data-screen=aim] [data-slot='{slot}'][aria-current=step]")
    wait_for_preview(page)


def test_four_pictures_need_at_most_eight_taps(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    page.evaluate(COUNT_TAPS)
    new_person(page)
    for slot in SLOTS:
        wait_for_aim(page, slot)
        page.wait_for_timeout(UNSEEN_MS)
        tap(page, f"{SHUTTER}[aria-disabled=false]")
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
    tap(page, "#next")
    page.wait_for_selector(".outcome .verdict")
    assert page.evaluate("taps") <= TAPS_MAX
    assert real.presses == 4
    assert [len(slot["captures"]) for slot in real.visit()["slots"].values()] == [1, 1, 1, 1]


def seconds_until_a_press_counts(page: Page, act: Callable[[], None], *presses_ms: int) -> float:
    """Take a picture; call `act` every 0.1 s until the page has gone on and a press has given the next picture."""
    tap(page, SHUTTER)
    page.wait_for_selector("[data-screen=picture]")
    page.evaluate(NOTE_TIMES, presses_ms)
    while page.evaluate("times.picture === undefined"):
        act()
        page.wait_for_timeout(100)
    return float(page.evaluate("times.picture - times.aim")) / 1000


def test_a_screen_that_changed_by_itself_takes_no_press_for_600_ms(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    assert seconds_until_a_press_counts(page, lambda: None, 450, 900, 1350) >= 0.6  # not debounced
    assert real.presses == 2


def test_nor_from_a_finger_or_key_that_was_already_down(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, has_touch=False, is_mobile=False)
    real.hold = "quick"
    page.locator(SHUTTER).focus()
    page.keyboard.down("Enter")
    page.wait_for_selector("[data-phase=making] #shutter")
    page.evaluate(TOUCH, "pointerdown")
    real.hold = None
    wait_for_aim(page, "R-nerve")
    page.wait_for_timeout(2 * UNSEEN_MS)
    expect(page.locator(SHUTTER)).to_be_focused()
    page.keyboard.down("Enter")  # its repetition
    page.wait_for_timeout(UNSEEN_MS)
    page.evaluate(TOUCH, "click")
    page.wait_for_timeout(UNSEEN_MS)
    assert real.presses == 1
    page.keyboard.up("Enter")
    page.keyboard.press("Enter")
    page.wait_for_selector("[data-screen=picture]")
    assert real.presses == 2


def test_nor_from_the_button_on_the_handle(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    assert seconds_until_a_press_counts(page, lambda: real.event_bus.publish("button")) >= 0.6
    assert real.presses == 2


@pytest.mark.parametrize("size", [SIZES["tablet"], SIZES["phone"]], ids=["tablet", "phone"])
def test_going_on_is_announced_and_undone(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    page = aiming(open_page, real, size)
    press_and_go_on(page, "R-nerve")
    expect(page.locator("[aria-live=polite]")).to_have_text("Right eye, Macula is good. Next: Right eye, Optic disc.")
    expect(page.locator(SHUTTER)).to_be_focused()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Optic disc")
    expect(page.locator("[data-code='shot.next'] p")).to_have_text("Right eye, Macula is good.")
    expect(page.locator("[data-code='shot.next'] .clock")).to_have_count(0)  # no time ends the undo
    assert look_for_faults(page, SHUTTER) == []
    tap(page, "[data-do=showAgain]")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("aria-current", "step")
    expect_to_stay(page)
    expect(page.locator("[aria-live=polite]")).to_be_empty()
    page.go_back()
    wait_for_aim(page, "R-nerve")
    page.go_back()
    expect_to_stay(page)
    assert real.presses == 1


def test_a_poor_picture_stays_with_its_advice(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    with real.poor_light("saturated"):
        tap(page, SHUTTER)
        expect_to_stay(page)
    expect(page.locator(".card")).to_contain_text("Too bright. Move back a little. Take again.")


def test_a_touch_of_the_picture_keeps_it(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    tap(page, SHUTTER)
    expect(page.locator(".card")).to_contain_text("The next one follows. Touch the picture to stay.")
    page.locator("#picture").tap()
    expect(page.locator(".card")).to_contain_text("Sharp and bright enough.")
    expect_to_stay(page)
    tap(page, "#next")
    wait_for_aim(page, "R-nerve")


def test_with_the_automatic_press_the_page_goes_on_by_a_tap_only(open_page: Open, real: Real) -> None:
    visit = real.begin_visit()["id"]
    page = open_page(f"{real.url}/#/visit/{visit}/patient")
    page.get_by_role("button", name="Menu").tap()
    page.locator("#auto").check()
    page.get_by_role("button", name="Close").tap()
    tap(page, "[data-value=agreed]")
    page.wait_for_timeout(SHOWN_MS)
    tap(page, "#shoot")
    page.wait_for_selector("[data-screen=picture]")
    expect_to_stay(page)
    assert real.presses == 1


def test_the_eye_is_lit_only_while_the_aiming_screen_is_shown(open_page: Open, real: Real) -> None:
    page = open_page(real.url)

    def expect_dark() -> None:
        wait_until_idle(real.rig)
        frames = real.rig.world.frames
        page.wait_for_timeout(1000)
        assert (real.rig.world.illumination, real.rig.world.frames) == (None, frames)

    expect_dark()
    tap(page, "#new")
    page.wait_for_selector("[data-screen=patient]")
    expect_dark()
    tap(page, "[data-value=agreed]")
    wait_for_aim(page, "R-centre")
    page.wait_for_timeout(UNSEEN_MS)
    press_and_go_on(page, "R-nerve")
    page.wait_for_timeout(UNSEEN_MS)
    tap(page, "#who")
    page.wait_for_selector("[data-screen=patient]")
    expect_dark()
    tap(page, "#shoot")
    wait_for_preview(page)
    take_picture(page)
    expect_dark()


def test_pictures_by_one_key(open_page: Open, real: Real) -> None:
    page = open_page(real.url, has_touch=False, is_mobile=False)
    page.locator("#new").focus()
    after_debounce(page).keyboard.press("Enter")
    expect(page.locator("#back")).to_be_focused()
    page.locator("[data-value=agreed]").focus()
    after_debounce(page).keyboard.press("Space")
    for slot in SLOTS:
        wait_for_aim(page, slot)
        page.wait_for_timeout(UNSEEN_MS)
        page.keyboard.press("Enter")
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
    assert real.presses == 4
