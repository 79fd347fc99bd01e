"""Consent and copying in a real browser against the real server: no light without consent, and a visit onto a stick."""

import json
import re
import secrets
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Complaints, free_port
from tests.browser.real import Real
from tests.browser.walk import SHUTTER, Open, live, new_person, settled, taken, tap
from tests.journey.faults import rest

pytestmark = pytest.mark.browser

STAGE = "eye-live"
WORDS = {
    "declined": ("This person did not agree. Take no pictures.", "Did not agree"),
    None: ("First ask: may we take pictures? Then choose the answer.", "First ask: may we?"),
}


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Real]:
    with Real(tmp_path_factory.mktemp("consent"), free_port()) as real:
        yield real


@pytest.fixture
def real(instrument: Real) -> Iterator[Real]:
    instrument.rig.app.state.notices.lease._until_s = 0.0  # the tablet of the test before is gone, without a word
    yield instrument
    instrument.pull_out()


def asked(real: Real, method: str, path: str, **body: Any) -> Any:
    """The answer to a request that comes from no page."""
    content = json.dumps({"key": secrets.token_hex(8), **body}).encode() if method != "GET" else None
    request = urllib.request.Request(f"{real.url}{path}", content, {"Content-Type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.loads(answer.read())


def visit_of(page: Page) -> str:
    found = re.search(r"visit/([^/]+)/", page.url)
    assert found is not None
    return found[1]


def answered(real: Real, visit: str, value: str | None) -> None:
    asked(real, "PATCH", f"/api/visits/{visit}", field="consent", value=value)


@pytest.mark.parametrize("value", WORDS)
def test_consent_withdrawn_elsewhere_darkens_the_lamp_and_the_page_says_why(
    open_page: Open, real: Real, complaints: Complaints, value: str | None
) -> None:
    complaints.expect("409")
    page = open_page(real.url)
    new_person(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false", timeout=15_000)
    visit, kept = visit_of(page), len(real.rig.store.captures(500))
    answered(real, visit, value)
    words, on_the_button = WORDS[value]
    expect(page.locator(".prompt .state-bar")).to_contain_text(words, timeout=10_000)
    expect(page.locator(SHUTTER)).to_contain_text(on_the_button)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)
    rest(real.rig)
    frames = real.rig.world.frames
    settled(page).locator(SHUTTER).tap(force=True)
    page.wait_for_timeout(3000)
    assert real.rig.world.frames == frames
    assert len(real.rig.store.captures(500)) == kept
    if value is None:
        tap(page, "[data-do=ask]")
        tap(page, "[data-value=agreed]")
        tap(page, "#shoot")
        live(page)
        taken(page)
    else:
        tap(page, ".state-bar [data-do=finish]")
        page.wait_for_selector("[data-screen=outcome]")


def test_a_press_that_is_refused_for_want_of_consent_is_told_and_keeps_nothing(
    open_page: Open, real: Real, complaints: Complaints
) -> None:
    """The page still believes that the person agreed: its preview hangs, and the press comes first."""
    complaints.expect("409")
    page = open_page(real.url)
    new_person(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false", timeout=15_000)
    page.route("**/api/preview**", lambda route: None)
    page.wait_for_timeout(3000)
    visit, kept = visit_of(page), len(real.rig.store.captures(500))
    answered(real, visit, "declined")
    tap(page, SHUTTER)
    expect(page.locator(".prompt .state-bar")).to_contain_text(WORDS["declined"][0])
    expect(page.locator(SHUTTER)).to_contain_text("Did not agree")
    expect(page.locator(".state-bar[data-code='consent.declined']")).to_have_count(1)
    assert len(real.rig.store.captures(500)) == kept
    page.unroute("**/api/preview**")


def test_a_test_picture_is_not_shown_as_one_of_a_visit(open_page: Open, real: Real) -> None:
    made = asked(real, "POST", "/api/captures", eye="OD")
    visit = asked(real, "POST", "/api/visits")["id"]
    answered(real, visit, "agreed")
    page = open_page(f"{real.url}/#/visit/{visit}/picture/R-centre/{made['id']}")
    expect(page.locator(".state-bar")).to_contain_text("This is a test picture. It belongs to no person.")
    assert page.locator(".stage[data-mark=final]").count() == 0


def test_a_visit_is_copied_to_a_usb_stick_from_its_history(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    new_person(page)
    taken(page)
    visit = asked(real, "GET", f"/api/visits/{visit_of(page)}")
    page.goto(f"{real.url}/#/history")
    tap(page, f".people [data-visit='{visit['id']}'], .people li:has-text('{visit['number'][:-1]}') button")
    page.wait_for_selector(".film")
    tap(page, "#copy")
    expect(page.locator(".film [role=note]")).to_have_text("No USB stick found. Put one in.")
    real.put_in()
    tap(page, "#copy")
    expect(page.locator(".film [data-folder]")).to_have_text(re.compile("USB STICK"))
    tap(page, ".film [data-folder]")
    expect(page.locator(".film [role=note]")).to_have_text("Copied to USB STICK.")
    (folder,) = real.stick.iterdir()
    assert folder.name == f"{visit['number']}-{visit['id']}"
    assert {path.name for path in folder.iterdir()} == {"R-centre-1.png", "R-centre-1.json", "visit.json", "SHA256SUMS"}
