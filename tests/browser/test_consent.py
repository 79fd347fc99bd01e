"""Consent and USB export in a real browser on the real server: no light without consent, and a copied visit."""

import re

import pytest
from playwright.sync_api import APIResponse, Route, expect

from tests.browser.conftest import Complaints
from tests.browser.real import Real
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    agree,
    new_person,
    take_picture,
    tap,
    visit_of,
)
from tests.journey.faults import wait_until_idle

pytestmark = pytest.mark.browser

STAGE = "eye-live"
WORDS = {
    "declined": ("This patient did not agree. Take no pictures.", "Did not agree"),
    None: ("Ask the patient first. Then choose the answer.", "Ask the patient first"),
}


def set_consent(real: Real, visit: str, value: str | None) -> None:
    real.record(visit, "consent", value)


@pytest.mark.parametrize("value", WORDS)
def test_consent_withdrawn_by_another_client_stops_light(
    open_page: Open, real: Real, complaints: Complaints, value: str | None
) -> None:
    complaints.expect("409")
    page = open_page(real.url)
    new_person(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    visit, kept = visit_of(page), len(real.rig.store.captures(500))
    set_consent(real, visit, value)
    words, on_the_button = WORDS[value]
    expect(page.locator(".prompt .state-bar")).to_contain_text(words)
    expect(page.locator(SHUTTER)).to_contain_text(on_the_button)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)
    wait_until_idle(real.rig)
    frames = real.rig.world.frames
    after_debounce(page).locator(SHUTTER).tap(force=True)
    page.wait_for_timeout(3000)
    assert real.rig.world.frames == frames
    assert len(real.rig.store.captures(500)) == kept
    if value is None:
        tap(page, "[data-do=ask]")
        agree(page)
        take_picture(page)
    else:
        tap(page, ".state-bar [data-do=finish]")
        page.wait_for_selector("[data-screen=outcome]")


def test_answer_from_before_the_consent_was_recorded_does_not_undo_it(open_page: Open, real: Real) -> None:
    """The aiming screen reads the visit while the consent is on its way, and gets the older answer last."""
    page = open_page(real.url)
    tap(page, "#new")
    page.wait_for_selector("[data-screen=patient]")
    changes: list[Route] = []
    answers: list[tuple[Route, APIResponse]] = []

    def hold(route: Route) -> None:
        if route.request.method == "PATCH":
            changes.append(route)
        elif changes and not answers:
            answers.append((route, route.fetch()))
        else:
            route.continue_()

    page.route(f"**/api/visits/{visit_of(page)}", hold)
    tap(page, "[data-value=agreed]")
    page.wait_for_selector("[data-screen=aim]")
    with page.expect_response(lambda response: response.request.method == "PATCH"):
        changes[0].continue_()
    page.wait_for_selector("eye-live[data-frame]")
    with page.expect_response(lambda response: response.request.method == "GET"):  # it asks again
        ((route, answer),) = answers
        route.fulfill(response=answer)
    assert answer.json()["fields"].get("consent") is None
    page.wait_for_timeout(500)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")


def test_capture_refused_without_consent_shows_alert(open_page: Open, real: Real, complaints: Complaints) -> None:
    """The page still shows consent, because its preview request hangs; the capture request is refused."""
    complaints.expect("409")
    page = open_page(real.url)
    new_person(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    page.route("**/api/preview**", lambda route: None)
    page.wait_for_timeout(3000)
    visit, kept = visit_of(page), len(real.rig.store.captures(500))
    set_consent(real, visit, "declined")
    tap(page, SHUTTER)
    expect(page.locator(".prompt .state-bar")).to_contain_text(WORDS["declined"][0])
    expect(page.locator(SHUTTER)).to_contain_text("Did not agree")
    expect(page.locator(".state-bar[data-code='consent.declined']")).to_have_count(1)
    assert len(real.rig.store.captures(500)) == kept
    page.unroute("**/api/preview**")


def test_test_picture_is_not_shown_in_visit(open_page: Open, real: Real) -> None:
    made = real.request("POST", "/api/captures", eye="OD")
    visit = real.begin_visit()["id"]
    set_consent(real, visit, "agreed")
    page = open_page(f"{real.url}/#/visit/{visit}/picture/R-centre/{made['id']}")
    expect(page.locator(".state-bar")).to_contain_text("This is a test picture. It belongs to no patient.")
    assert page.locator(".stage[data-mark=final]").count() == 0


def test_visit_is_copied_to_usb_drive(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    new_person(page)
    take_picture(page)
    visit = real.visit(visit_of(page))
    page.goto(f"{real.url}/#/history")
    tap(page, f".people [data-visit='{visit['id']}'], .people li:has-text('{visit['number'][:-1]}') button")
    page.wait_for_selector(".pictures")
    tap(page, "#copy")
    expect(page.locator(".pictures [role=note]")).to_have_text("No USB stick found. Put one in.")
    real.mount()
    tap(page, "#copy")
    expect(page.locator(".pictures [data-folder]")).to_have_text(re.compile("USB STICK"))
    tap(page, ".pictures [data-folder]")
    expect(page.locator(".pictures [role=note]")).to_have_text("Copied to USB STICK.")
    (folder,) = real.stick.iterdir()
    assert folder.name == f"{visit['number']}-{visit['id']}"
    assert {path.name for path in folder.iterdir()} == {
        "R-centre-1.png",
        "R-centre-1-colour.png",
        "R-centre-1.json",
        "visit.json",
        "history.json",
        "SHA256SUMS",
    }
