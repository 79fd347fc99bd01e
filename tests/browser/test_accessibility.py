"""Accessibility: keyboard only, magnification up to 400 %, disabled letter keys, reduced motion."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.looks import look_for_faults
from tests.browser.real import Real
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    agree,
    aiming,
    stay,
    take_picture,
    tap,
    visit_of,
    wait_for_preview,
)

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
# 1280 x 1024, magnified, and the smallest phone (WCAG 1.4.4 and 1.4.10).
MAGNIFIED = {"200 %": (640, 512), "400 %": (320, 256), "narrow": (320, 568)}


def reach(page: Page, selector: str, back: bool = False) -> None:
    """Move the focus to a control with the Tab key."""
    page.locator(selector).wait_for()
    after_debounce(page)
    for _ in range(60):
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
        page.keyboard.press("Shift+Tab" if back else "Tab")
    raise AssertionError(f"the keyboard does not come to {selector}")


def strike(page: Page, selector: str, key: str = "Enter", back: bool = False) -> None:
    reach(page, selector, back)
    page.keyboard.press(key)


def test_visit_by_keyboard_only(open_page: Open, real: Real) -> None:
    page = open_page(real.url, has_touch=False, is_mobile=False)
    strike(page, "#new")
    strike(page, "#say")  # without a voice, the sentence is shown in a dialog
    expect(page.locator("dialog[open] #sentence")).to_be_visible()
    page.keyboard.press("Escape")
    strike(page, "[data-value=agreed]", "Space")
    wait_for_preview(page)
    reach(page, SHUTTER)
    with real.poor_light("saturated"):
        after_debounce(page).keyboard.press("Space")
        page.wait_for_selector("[data-phase=kept] [data-verdict=again]")
    after_debounce(page).keyboard.press("r")
    wait_for_preview(page)
    after_debounce(page).keyboard.press("Enter")
    stay(page)
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    after_debounce(page).keyboard.press("n")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Optic disc")
    with real.poor_light("saturated"):
        for _ in range(2):
            real.press(visit_of(page), "R-nerve")
        strike(page, SHUTTER)
        page.wait_for_selector("[data-phase=kept] [data-verdict=again]")
        strike(page, "#not-possible")
    strike(page, "[data-reason=still]")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Macula")
    strike(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    strike(page, "#finish")
    strike(page, "#finish-without")
    strike(page, "#done")
    expect(page.locator(".day")).to_contain_text("1 done")
    states = [slot["state"] for slot in real.visit()["slots"].values()]
    assert states == ["taken", "not_possible", "taken", "empty"]
    assert real.presses == 4


def test_disabled_letter_keys_leave_shutter_keys_active(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, has_touch=False, is_mobile=False)
    strike(page, "#open-menu", back=True)
    strike(page, "#menu summary")
    strike(page, "#letters", "Space")
    page.keyboard.press("Escape")
    reach(page, SHUTTER)
    after_debounce(page).keyboard.press("Space")
    stay(page)
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    for key in "rng?1":
        after_debounce(page).keyboard.press(key)
    expect(page.locator(".page")).to_have_attribute("data-screen", "picture")
    expect(page.locator("dialog[open]")).to_have_count(0)
    strike(page, "#next")  # each letter key has an equivalent button
    expect(page.locator(SHUTTER)).to_contain_text("Optic disc")


@pytest.mark.parametrize("size", MAGNIFIED.values(), ids=MAGNIFIED.keys())
def test_magnified_page_scrolls_in_one_direction(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    page = open_page(real.url, size)
    page.wait_for_selector("#new")
    faults = {"home": look_for_faults(page)}
    tap(page, "#new")
    page.wait_for_selector("#say")
    faults["patient"] = look_for_faults(page)
    agree(page)
    page.wait_for_selector("#say")
    faults["aim"] = look_for_faults(page)
    take_picture(page)
    faults["result"] = look_for_faults(page)
    for name in ("#next", "#again"):
        page.locator(name).scroll_into_view_if_needed()
        expect(page.locator(name)).to_be_in_viewport(ratio=1)
    assert faults == {name: [] for name in faults}


def test_motion_respects_prefers_reduced_motion() -> None:
    """Motion is styled only under `prefers-reduced-motion: no-preference`.

    A rule that resets motion would not be enough: it does not reach into a progress bar.
    """
    welcome = re.compile(r"@media \(prefers-reduced-motion: no-preference\) \{.*?\n\}", re.S)
    sheets = {sheet.name: sheet.read_text() for sheet in (WEB / "styles").glob("*.css")}
    assert any(welcome.search(text) for text in sheets.values())
    moving = re.compile(r"^\s*(transition|animation|scroll-behavior)[\w-]*:", re.M)
    assert [name for name, text in sheets.items() if moving.search(welcome.sub("", text))] == []
