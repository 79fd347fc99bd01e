"""axe-core checks of every screen of the exam page; `test_alerts` checks the alerts."""

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.real import Real
from tests.browser.walk import SHUTTER, Open, aiming, finish_early, take_picture, tap

pytestmark = pytest.mark.browser


HINTS = {
    "noeye": ("No eye found", lambda real: real.rig.world.faults.add("eye.closed")),
    "back": ("Move back a little", lambda real: (real.rig.world.faults.clear(), real.show("pupil"))),
    "ready": ("Ready.", lambda real: real.show(None)),
}


class AxeRun:
    """Violations by screen name; `assert_clean` also requires a minimum number of checks."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.faults: dict[str, list[str]] = {}

    def check(self, name: str, mark: str) -> None:
        self.page.wait_for_selector(mark)
        self.faults[name] = axe_faults(self.page)
        self.page.locator("[data-link=live]").wait_for()  # axe blocks the page long enough to miss heartbeats

    def open(self, place: str, mark: str) -> None:
        self.page.goto(f"{self.page.url.split('#')[0]}#/{place}")
        self.check(place, mark)

    def assert_clean(self, least: int) -> None:
        assert {name: found for name, found in self.faults.items() if found} == {}
        assert len(self.faults) >= least


def test_no_axe_violation_on_any_screen(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    axe = AxeRun(page)
    for _ in range(2):
        take_picture(page)
        tap(page, "#again")
    visit = real.visit()
    first, second = visit["slots"]["R-centre"]["captures"]
    axe.open("", "#new")
    page.get_by_role("button", name="Menu").tap()
    axe.check("menu", "dialog[open]")
    page.keyboard.press("Escape")
    axe.open("find", ".people")
    axe.open(f"visit/{visit['id']}/patient", ".patient")
    axe.open("history", ".history .people")
    axe.open(f"visit/{visit['id']}/pictures", ".pictures .pick")
    axe.open(f"visit/{visit['id']}/compare/{first}/{second}", ".two figure:last-child eye-pic[data-mark=final]")
    axe.open(f"visit/{visit['id']}/outcome", ".outcome")
    axe.open(f"visit/{visit['id']}/aim/R-nerve", "eye-live[data-frame]")
    finish_early(page)
    tap(page, "#code")
    axe.check("finished", "figure.code svg path")
    axe.assert_clean(10)


def test_no_axe_violation_during_capture_and_verdict(open_page: Open, real: Real) -> None:
    real.hold = "expose"
    page = aiming(open_page, real)
    axe = AxeRun(page)
    tap(page, SHUTTER)
    axe.check("making", "[data-phase=making]")
    real.show("pupil")
    real.hold = "quick"
    axe.check("assessed", "[data-phase=assessed] .stage[data-mark=quick]")
    real.hold = None
    axe.check("shot.pupil", "[data-phase=kept] .stage[data-mark=final]")
    real.show(None)
    tap(page, "#again")
    take_picture(page)
    axe.check("good", "[data-verdict=good]")
    tap(page, "#open-details")
    axe.check("details", "#details[open]")
    page.keyboard.press("Escape")
    real.show("saturated")
    tap(page, "#again")
    take_picture(page)
    axe.check("shot.poor", "#not-possible")
    tap(page, "#not-possible")
    axe.check("why", ".reasons")
    axe.assert_clean(7)


def test_no_axe_violation_in_any_hint(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    axe = AxeRun(page)
    for hint, (words, show) in HINTS.items():
        show(real)
        expect(page.locator(".prompt")).to_contain_text(words)
        axe.check(f"aim.{hint}", "eye-live[data-frame]")
    axe.assert_clean(3)


def test_axe_detects_violations_in_both_themes(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    page.wait_for_selector("#new")
    page.evaluate("document.querySelector('#new').setAttribute('aria-labelledby', 'nowhere')")
    page.evaluate("document.querySelector('.home').append(document.createElement('img'))")
    page.evaluate("document.querySelector('#find').style.color = 'gray'")
    found = " ".join(axe_faults(page))
    assert "dim: image-alt" in found
    assert "dim: color-contrast" in found
    assert "daylight: color-contrast" in found
