"""Functions that operate the exam page: aim, press, wait for verdict and picture."""

import re
import time
from collections.abc import Callable
from urllib.parse import urljoin

from playwright.sync_api import Locator, Page, expect

from tests.browser.real import Real
from tests.journey.conftest import until

SHUTTER = "#shutter"
DEBOUNCE_MS = 450  # debounce time of the page (400 ms) and a margin
UNSEEN_MS = 650  # for 600 ms a screen that changed by itself takes no press
SHOWN_MS = 2500  # for 1.5 s a good picture is shown before the page goes on
Open = Callable[..., Page]


def wait_for_preview(page: Page) -> int:
    """Wait for a live frame; return its number."""
    page.wait_for_selector("eye-live[data-frame]")
    return int(page.locator("eye-live").get_attribute("data-frame") or 0)


def wait_for_release(page: Page) -> None:
    """Wait until no screen holds the camera: the page of another test lets go of it 2 s after it has closed."""
    until(lambda: page.request.get(urljoin(page.url, "/api/status")).json()["controller"] is None)


def after_debounce(page: Page) -> Page:
    page.wait_for_timeout(DEBOUNCE_MS)
    return page


def tap(page: Page, selector: str) -> None:
    """Tap an element after the debounce time."""
    page.locator(selector).first.wait_for()
    after_debounce(page).locator(selector).first.tap()


def aiming(
    open_page: Open, real: Real, size: tuple[int, int] = (1280, 800), slot: str = "R-centre", **options: object
) -> Page:
    """Open a page that aims at a slot of a new patient with consent."""
    visit = real.begin_visit(consent="agreed", sex="woman", age=54)
    page = open_page(f"{real.url}/#/visit/{visit['id']}/aim/{slot}", size, **options)
    wait_for_preview(page)
    expect(page.locator(".state")).not_to_have_attribute("data-state", "opening")
    return after_debounce(page)


def visit_of(page: Page) -> str:
    """Return the id of the visit in the address of the page."""
    found = re.search(r"visit/([^/]+)/", page.url)
    assert found is not None
    return found[1]


def new_person(page: Page) -> None:
    """Go from Home to a live picture in two taps."""
    tap(page, "#new")
    agree(page)


def agree(page: Page) -> None:
    """Answer the question for consent, and wait until the page aims and takes presses."""
    tap(page, "[data-value=agreed]")
    wait_for_preview(page)
    page.wait_for_timeout(UNSEEN_MS)


def stay(page: Page) -> None:
    """Touch the picture screen, so that it does not go on by itself."""
    page.locator("[data-screen=picture] .prompt").dispatch_event("pointerdown")


def take_picture(page: Page) -> None:
    """Press the shutter, stay, and wait for the final picture."""
    page.wait_for_selector("[data-screen=aim]")
    tap(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")


def expect_to_stay(page: Page) -> None:
    """Check that the page does not go on by itself from the final picture."""
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    page.wait_for_timeout(SHOWN_MS)
    expect(page.locator("[data-screen=picture] #again")).to_be_visible()


def finish_early(page: Page) -> None:
    """Finish the visit although pictures are missing."""
    tap(page, "#finish")
    page.locator("#finish-without").tap()


def double_tap(page: Page, x: float, y: float) -> None:
    """Send two taps 0.15 s apart by their event time stamps, independent of the computer's load."""
    touch = page.context.new_cdp_session(page)
    begin_s = time.time() - 0.3
    for after_s in (0.0, 0.15):
        for kind, points, at_s in (("touchStart", [{"x": x, "y": y}], 0.0), ("touchEnd", [], 0.05)):
            when = {"timestamp": begin_s + after_s + at_s}
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points, **when})
    touch.detach()


def wait_until_drawn(page: Page, tools: str, which: str = "#picture") -> None:
    """Wait until the final picture is drawn with these tools ("red-free 0 1": brightness, contrast)."""
    expect(page.locator(which)).to_have_attribute("data-drawn", f"final {tools}")


def loupe_position(pic: Locator) -> tuple[float, float]:
    """Return the loupe's position in picture widths from the centre."""
    expect(pic).to_have_attribute("data-loupe", re.compile("."))
    u, v = (pic.get_attribute("data-loupe") or "").split(",")
    return float(u), float(v)


def set_language(page: Page, language: str) -> None:
    """Set the language of all pages of this context."""
    page.context.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")


def switch_language(page: Page, language: str) -> None:
    """Switch the language of an open page, as the buttons of the home screen do, and wait for the new layout."""
    page.evaluate(
        """async (language) => {
          const entry = document.querySelector("script[type=module]").src;
          const { actions } = await import(new URL("core/actions.js", entry).href);
          await actions.setLanguage(language);
          await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
        }""",
        language,
    )
    expect(page.locator("html")).to_have_attribute("lang", language)
