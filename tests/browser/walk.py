"""How the tests walk through the page: to a live picture, through a press, to a verdict."""

import re
import time
from collections.abc import Callable

from playwright.sync_api import Locator, Page, expect

from tests.browser.stub import Stubbed

SHUTTER = "#shutter"
LOCK_MS = 450  # the page ignores presses for 400 ms after every change of screen
Open = Callable[..., Page]


def live(page: Page) -> int:
    """Wait for a live picture; its number."""
    page.wait_for_selector("eye-live[data-frame]")
    return int(page.locator("eye-live").get_attribute("data-frame") or 0)


def settled(page: Page) -> Page:
    page.wait_for_timeout(LOCK_MS)
    return page


def tap(page: Page, selector: str) -> None:
    """Tap as a person would: not within the blink of an eye after the last change."""
    page.locator(selector).first.wait_for()
    settled(page).locator(selector).first.tap()


def aiming(open_page: Open, stub: Stubbed, size: tuple[int, int] = (1280, 800), **options: object) -> Page:
    """A page that aims at the first slot of a person who agreed."""
    visit = stub.stub.visits.begin(consent="agreed", sex="woman", age=54)
    page = open_page(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre", size, **options)
    live(page)
    expect(page.locator(".state")).not_to_have_attribute("data-state", "opening")
    if (
        settled(page).locator("[data-do=useHere]").count()
    ):  # the page of the test before asked once more while it closed
        page.locator("[data-do=useHere]").tap()
    return page


def new_person(page: Page) -> None:
    """From Home to a live picture in three taps."""
    tap(page, "#new")
    tap(page, "[data-value=agreed]")
    tap(page, "#shoot")
    live(page)


def taken(page: Page) -> None:
    """Press, and wait until the final picture is drawn."""
    tap(page, SHUTTER)
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")


def double_tap(page: Page, x: float, y: float) -> None:
    """Two taps 0.15 s apart by their own time, however busy this computer is."""
    touch = page.context.new_cdp_session(page)
    begin_s = time.time() - 0.3
    for after_s in (0.0, 0.15):
        for kind, points, at_s in (("touchStart", [{"x": x, "y": y}], 0.0), ("touchEnd", [], 0.05)):
            when = {"timestamp": begin_s + after_s + at_s}
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points, **when})
    touch.detach()


def drawn(page: Page, tools: str, which: str = "#picture") -> None:
    """Wait until the final picture is on the glass under these tools ("red-free 0 1": brightness, contrast)."""
    expect(page.locator(which)).to_have_attribute("data-drawn", f"final {tools}", timeout=20_000)


def place_of(pic: Locator) -> tuple[float, float]:
    """Where the loupe is, in widths of the picture from its middle."""
    expect(pic).to_have_attribute("data-loupe", re.compile("."))
    u, v = (pic.get_attribute("data-loupe") or "").split(",")
    return float(u), float(v)


def spoken(page: Page, language: str) -> None:
    """Let every page of this context speak a language from its start."""
    page.context.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")
