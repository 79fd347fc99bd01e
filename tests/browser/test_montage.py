"""Montage of each eye on the pictures screen: the joined picture, by keyboard, or the reason why there is none.

The small sensor of these tests does not resolve vessels, so answers about the right eye are given here; tests/journey
joins pictures on the real server.
"""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from services.imaging.picture_files import to_png
from tests.browser.looks import look_for_faults
from tests.browser.real import Real
from tests.browser.test_accessibility import reach
from tests.browser.walk import Open
from tests.moving_retina import WIDE_RETINA, gaze

pytestmark = pytest.mark.browser

NO_PLACE = {"shift_px": None, "rotation_deg": None, "peak": None, "overlap": None, "reason": None}


def pictures_screen(open_page: Open, real: Real, state: list[str], used: int = 0, pictures: int = 2) -> Page:
    """Open the pictures of a visit whose montage of the right eye has the last one of the states."""
    visit = real.begin_visit(consent="agreed")["id"]
    real.press(visit, "L-centre")
    placed = [{"index": k, "slot": "R-centre", "capture": "x", "used": k < used} | NO_PLACE for k in range(pictures)]

    def answer(route: Any) -> None:
        body = {"state": state[-1], "digest": "0" * 64, "pictures": pictures, "placed": placed, "problem": None}
        route.fulfill(json=body)

    page = open_page(real.url)
    page.route("**/montage/OD", answer)
    png = to_png(gaze(WIDE_RETINA, (0, 0)), True)
    page.route("**/montage/OD/picture.png?*", lambda route: route.fulfill(body=png, content_type="image/png"))
    page.goto(f"{real.url}/#/visit/{visit}/pictures")
    return page


def test_joined_pictures_are_shown_once_they_are_known(open_page: Open, real: Real) -> None:
    state = ["computing"]
    page = pictures_screen(open_page, real, state, used=2, pictures=3)
    right, left = page.locator(".montage[data-eye=OD]"), page.locator(".montage[data-eye=OS]")
    expect(left).to_contain_text("One picture: there is nothing to join.")  # the answer of the server
    expect(left.locator("eye-pic")).to_have_count(0)
    expect(right.locator("[aria-live]")).to_contain_text("Joining the pictures")
    state.append("joined")  # the page asks again by itself
    expect(right.locator("[aria-live]")).to_have_text(
        "2 pictures are joined to one. A picture of another part is left out."
    )
    expect(right.get_by_role("img", name="Right eye: 2 pictures joined to one")).to_be_visible()
    page.wait_for_selector(".montage eye-pic[data-drawn^=final]")
    reach(page, ".montage eye-pic")
    page.keyboard.press("+")
    expect(page.locator(".montage eye-pic")).to_have_attribute("data-zoom", "1.50")
    assert look_for_faults(page) == []


@pytest.mark.parametrize(
    ("state", "words"),
    [("apart", "Not joined: the pictures show different parts of the eye."), ("failed", "could not be joined")],
)
def test_without_a_montage_there_is_the_reason(open_page: Open, real: Real, state: str, words: str) -> None:
    page = pictures_screen(open_page, real, [state])
    expect(page.locator(".montage[data-eye=OD]")).to_contain_text(words)
    expect(page.locator(".montage eye-pic")).to_have_count(0)
