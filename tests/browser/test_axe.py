"""axe-core finds nothing on any screen or in any state of the screener's page; the technician's tests ask it too."""

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.stub import Stubbed
from tests.browser.test_states import STOPS, TELLS, over, tell
from tests.browser.walk import SHUTTER, Open, aiming, taken, tap

pytestmark = pytest.mark.browser


class Looked:
    """What axe said of each place; a place that was not looked at is no proof."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.faults: dict[str, list[str]] = {}

    def at(self, name: str, mark: str) -> None:
        self.page.wait_for_selector(mark)
        self.faults[name] = axe_faults(self.page)
        self.page.locator("[data-link=live]").wait_for()  # axe held the page so long that it may have missed beats

    def go(self, place: str, mark: str) -> None:
        self.page.goto(f"{self.page.url.split('#')[0]}#/{place}")
        self.at(place, mark)

    def clean(self, least: int) -> None:
        assert {name: found for name, found in self.faults.items() if found} == {}
        assert len(self.faults) >= least


def test_axe_finds_nothing_on_any_screen(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    looked = Looked(page)
    for _ in range(2):
        taken(page)
        tap(page, "#again")
    first, second = next(iter(stub.stub.visits.kept.values()))["slots"]["R-centre"]["captures"]
    looked.go("", "#new")
    page.get_by_role("button", name="Menu").tap()
    looked.at("menu", "dialog[open]")
    page.keyboard.press("Escape")
    looked.go("find", ".people")
    looked.go("visit/v142/person", ".person")
    looked.go("history", ".history .people")
    looked.go("visit/v142/film", ".film .pick")
    looked.go(f"visit/v142/compare/{first}/{second}", ".two figure:last-child eye-pic[data-mark=final]")
    looked.go("visit/v142/outcome", ".outcome")
    looked.go("visit/v142/aim/R-nerve", "eye-live[data-frame]")
    tap(page, "#finish")
    tap(page, "#code")
    looked.at("finished", "figure.code svg path")
    looked.clean(10)


def test_axe_finds_nothing_while_a_picture_is_made_and_told(open_page: Open, stub: Stubbed) -> None:
    stub.stub.hold, stub.stub.verdicts = "verdict", ["shot.pupil"]
    page = aiming(open_page, stub)
    looked = Looked(page)
    tap(page, SHUTTER)
    looked.at("making", ".stage[data-mark=quick]")
    stub.stub.hold = "keep"
    looked.at("told", "[data-phase=told]")
    stub.stub.hold = None
    looked.at("shot.pupil", "[data-phase=kept] .stage[data-mark=final]")
    tap(page, "#again")
    taken(page)
    looked.at("good", "[data-verdict=good]")
    tap(page, "#open-details")
    looked.at("details", "#details[open]")
    page.keyboard.press("Escape")
    stub.stub.verdicts = ["shot.dark"]
    stub.stub.visits.kept["v142"]["slots"]["R-centre"]["tries"] = 3
    tap(page, "#again")
    taken(page)
    looked.at("shot.poor", "#could-not")
    tap(page, "#could-not")
    looked.at("why", ".reasons")
    looked.clean(7)


def test_axe_finds_nothing_in_any_state(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    looked = Looked(page)
    for code in [*STOPS, *TELLS]:
        tell(stub, page, code)
        looked.at(code, f"[data-code='{code}']")
        over(stub, page, code)
    for hint, words in {"noeye": "No eye seen", "closer": "a little closer", "ready": "Ready."}.items():
        stub.stub.aim = {"code": hint, "fill": 0.5}
        expect(page.locator(".prompt")).to_contain_text(words)
        looked.at(f"aim.{hint}", "eye-live[data-frame]")
    looked.clean(24)


def test_axe_would_find_what_is_wrong_in_either_theme(open_page: Open, stub: Stubbed) -> None:
    page = open_page(stub.url)
    page.wait_for_selector("#new")
    page.evaluate("document.querySelector('#new').setAttribute('aria-labelledby', 'nowhere')")
    page.evaluate("document.querySelector('.home').append(document.createElement('img'))")
    page.evaluate("document.querySelector('#find').style.color = 'gray'")
    found = " ".join(axe_faults(page))
    assert "dim: image-alt" in found
    assert "dim: color-contrast" in found
    assert "daylight: color-contrast" in found
