"""A visit without a finger, on a screen magnified four times, with letters switched off, and without motion."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.looks import look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, live, settled, taken, tap

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
# A screen of 1280 by 1024, magnified; and the smallest phone (WCAG 1.4.4 and 1.4.10).
MAGNIFIED = {"200 %": (640, 512), "400 %": (320, 256), "narrow": (320, 568)}


def reach(page: Page, selector: str, back: bool = False) -> None:
    """Go from control to control with the Tab key alone, until this one has the focus."""
    settled(page).locator(selector).wait_for()
    for _ in range(60):
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
        page.keyboard.press("Shift+Tab" if back else "Tab")
    raise AssertionError(f"the keyboard does not come to {selector}")


def strike(page: Page, selector: str, key: str = "Enter", back: bool = False) -> None:
    reach(page, selector, back)
    page.keyboard.press(key)


def test_a_whole_visit_by_keyboard_alone(open_page: Open, stub: Stubbed) -> None:
    stub.stub.expose_s, stub.stub.refine_s = 0.02, 0.1
    stub.stub.verdicts = ["shot.moved", None, "shot.pupil", None]
    page = open_page(stub.url, has_touch=False, is_mobile=False)
    strike(page, "#new")
    strike(page, "#say")  # no voice here: the sentence stands large in a dialog
    expect(page.locator("dialog[open] #sentence")).to_be_visible()
    page.keyboard.press("Escape")
    strike(page, "[data-value=agreed]", "Space")
    strike(page, "#shoot")
    live(page)
    reach(page, SHUTTER)
    settled(page).keyboard.press("Space")
    page.wait_for_selector("[data-phase=kept] [data-verdict=again]")
    settled(page).keyboard.press("r")
    live(page)
    settled(page).keyboard.press("Enter")
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    settled(page).keyboard.press("n")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Nerve")
    next(iter(stub.stub.visits.kept.values()))["slots"]["R-nerve"]["tries"] = 2  # as if it had been tried twice
    strike(page, SHUTTER)
    strike(page, "#could-not")
    strike(page, "[data-reason=still]")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Centre")
    strike(page, SHUTTER)
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    strike(page, "#finish")
    strike(page, "#done")
    expect(page.locator(".day")).to_contain_text("1 done")
    states = [slot["state"] for slot in next(iter(stub.stub.visits.kept.values()))["slots"].values()]
    assert states == ["taken", "could_not", "taken", "empty"]
    assert stub.stub.presses == 4


def test_letters_that_are_switched_off_do_nothing_and_the_shutter_keys_still_work(
    open_page: Open, stub: Stubbed
) -> None:
    page = aiming(open_page, stub, has_touch=False, is_mobile=False)
    strike(page, "#open-menu", back=True)
    strike(page, "#menu summary")
    strike(page, "#letters", "Space")
    page.keyboard.press("Escape")
    reach(page, SHUTTER)
    settled(page).keyboard.press("Space")
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    for key in "rng?1":
        settled(page).keyboard.press(key)
    expect(page.locator(".page")).to_have_attribute("data-screen", "picture")
    expect(page.locator("dialog[open]")).to_have_count(0)
    strike(page, "#next")  # what a letter did, a button does
    expect(page.locator(SHUTTER)).to_contain_text("Nerve")


@pytest.mark.parametrize("size", MAGNIFIED.values(), ids=MAGNIFIED.keys())
def test_a_magnified_page_scrolls_in_one_direction_only(open_page: Open, stub: Stubbed, size: tuple[int, int]) -> None:
    page = open_page(stub.url, size)
    page.wait_for_selector("#new")
    faults = {"home": look_for_faults(page)}
    tap(page, "#new")
    page.wait_for_selector("#say")
    faults["person"] = look_for_faults(page)
    tap(page, "[data-value=agreed]")
    tap(page, "#shoot")
    live(page)
    page.wait_for_selector("#say")
    faults["aim"] = look_for_faults(page)
    taken(page)
    faults["result"] = look_for_faults(page)
    for name in ("#next", "#again"):
        page.locator(name).scroll_into_view_if_needed()
        expect(page.locator(name)).to_be_in_viewport(ratio=1)
    assert faults == {name: [] for name in faults}


def test_nothing_moves_unless_motion_is_welcome() -> None:
    """No element may move by itself outside of what the browser applies where nobody asked for less motion.

    A rule that takes motion back from everything would not do: it does not reach into a progress bar.
    """
    welcome = re.compile(r"@media \(prefers-reduced-motion: no-preference\) \{.*?\n\}", re.S)
    sheets = {sheet.name: sheet.read_text() for sheet in WEB.glob("*.css")}
    assert any(welcome.search(text) for text in sheets.values())
    moving = re.compile(r"^\s*(transition|animation|scroll-behavior)[\w-]*:", re.M)
    assert [name for name, text in sheets.items() if moving.search(welcome.sub("", text))] == []
