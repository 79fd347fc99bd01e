"""Lost, interrupted and wrong-eye captures, early finish, and finished visits."""

import re

import pytest
from playwright.sync_api import Page, expect

from tests.browser.alert_causes import CAUSES
from tests.browser.conftest import Complaints, MakeReal, Server
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Real
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    aiming,
    finish_early,
    new_person,
    stay,
    take_picture,
    tap,
    visit_of,
    wait_for_preview,
    wait_for_release,
)
from tests.journey.conftest import DAY_S, until

pytestmark = pytest.mark.browser

SLOTS = ["R-centre", "R-nerve", "L-centre", "L-nerve"]
FAST = 3  # visits; tap interval 0.5 s


def begin_visit(page: Page, real: Real) -> str:
    """Open the first slot of another patient with consent."""
    visit = str(real.begin_visit(consent="agreed")["id"])
    page.goto(f"{real.url}/#/visit/{visit}/aim/R-centre")
    return visit


def wait_for_verdict(page: Page) -> None:
    page.wait_for_selector("[data-phase=assessed], [data-phase=kept]")


def test_the_eye_is_held_still_until_the_last_frame_also_with_a_quick_look(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    begin_visit(page, real)
    real.hold = "look"
    tap(page, f"{SHUTTER}[aria-disabled=false]")
    page.wait_for_selector("[data-mark=quick]")
    expect(page.locator(".prompt")).to_contain_text("Hold the camera still")
    expect(page.locator(SHUTTER)).to_contain_text("Taking the picture")
    real.hold = None
    wait_for_verdict(page)
    expect(page.locator(".prompt")).not_to_contain_text("Hold the camera still")


def test_fast_tapping_keeps_every_picture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    for _ in range(FAST):
        visit = begin_visit(page, real)
        for slot in SLOTS:
            expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("aria-current", "step")
            tap(page, f"{SHUTTER}[aria-disabled=false]")
            stay(page)
            wait_for_verdict(page)
            expect(page.locator("#result-title")).to_have_text("Good")
            expect(page.locator(".prompt")).not_to_contain_text("Hold the camera still")
            expect(page.locator(".state")).not_to_have_text("Taking")
            if slot != SLOTS[-1]:
                tap(page, "#next")
        expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
        slots = real.visit(visit)["slots"]
        assert [len(slots[slot]["captures"]) for slot in SLOTS] == [1, 1, 1, 1]
    assert real.presses == 4 * FAST


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_lost_picture_is_reported_until_retaken(
    open_page: Open, real: Real, complaints: Complaints, size: tuple[int, int]
) -> None:
    complaints.expect("507")
    real.free_space.is_failing, real.hold = True, "stored"
    page = aiming(open_page, real, size)
    page.locator(SHUTTER).tap()
    wait_for_verdict(page)
    expect(page.locator("#result-title")).to_have_text("Good")
    tap(page, "#next")
    wait_for_preview(page)
    real.hold = None
    chip = page.locator("[data-code='shot.lost']")
    expect(chip.get_by_role("alert")).to_have_text("Right eye, Macula: no picture was saved. Please take it again.")
    real.free_space.is_failing = False
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "lost")
    assert look_for_faults(page, SHUTTER) == []
    take_picture(page)  # the next press keeps the chip
    expect(chip).to_be_visible()
    page.locator("[data-do=takeNow]").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Macula")
    take_picture(page)
    expect(chip).to_have_count(0)
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")


def test_light_cut_returns_to_the_same_slot(open_page: Open, make_real: MakeReal, complaints: Complaints) -> None:
    complaints.expect("423")
    real = make_real(max_on_s=1.0)
    page = aiming(open_page, real)
    real.event_bus.on_press = real.rig.block_exposures
    page.locator(SHUTTER).tap()
    until(lambda: not real.clock.gate.is_set())
    real.rig.wait_for_blocked_exposure()
    until(lambda: real.rig.world.illumination is None)  # the guard has ended the light
    real.clock.gate.set()
    expect(page.locator(".state-bar")).to_contain_text("The light went out too early. Please take it again.")
    expect(page.locator("[data-screen=aim] #shutter")).to_contain_text("Right eye · Macula")
    expect(page.locator("#next")).to_have_count(0)
    take_picture(page)
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-code='shot.lost'], .state-bar")).to_have_count(0)


def test_lost_answer_is_queried_after_reconnection(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("ERR_FAILED", "404")
    real.hold = "stored"
    page = aiming(open_page, real)
    page.route("**/api/captures", lambda route: route.fetch() and route.abort())
    page.locator(SHUTTER).tap()
    wait_for_verdict(page)
    tap(page, "#next")
    real.free_space.is_failing, real.hold = True, None
    expect(page.locator("[data-code='shot.lost']")).to_be_visible(timeout=20_000)


def test_finish_waits_for_pending_capture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    real.hold = "stored"
    tap(page, "[data-slot='L-centre']")
    tap(page, SHUTTER)
    wait_for_verdict(page)
    finish_early(page)
    expect(page.locator("#finishing h2")).to_have_text("One picture is still being processed")
    expect(page.locator("#finishing progress")).to_be_visible()
    assert look_for_faults(page) == []
    assert real.visit()["finished_at"] is None
    real.hold = None
    page.wait_for_selector("[data-outcome=send]")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")


def test_picture_lost_during_finish_is_requested_again(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("507")
    real.free_space.is_failing, real.hold = True, "stored"
    page = aiming(open_page, real)
    tap(page, SHUTTER)
    wait_for_verdict(page)
    finish_early(page)
    page.wait_for_selector("#finishing")
    real.hold = None
    expect(page.locator("[data-code='shot.lost']")).to_be_visible()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Macula")
    assert real.visit()["finished_at"] is None


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_not_possible_is_set_and_undone_while_aiming(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    page = aiming(open_page, real, size)
    assert look_for_faults(page, SHUTTER) == []
    tap(page, "#not-possible")
    reasons = page.locator("[data-reason]")
    assert [reason.get_attribute("data-reason") for reason in reasons.all()][0::6] == ["lids", "other"]
    assert look_for_faults(page) == []
    tap(page, "[data-reason=lids]")
    tile = page.locator("[data-slot='R-centre']")
    expect(tile).to_have_attribute("data-face", "not_possible")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Optic disc")
    expect(page.locator("[data-code='shot.crossed']")).to_contain_text("Right eye, Macula: not possible.")
    assert look_for_faults(page, SHUTTER) == []
    tap(page, "[data-do=uncross]")
    expect(tile).to_have_attribute("data-face", "empty")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Macula")
    tap(page, "#not-possible")
    tap(page, "[data-reason=other]")
    tap(page, "[data-slot='R-centre']")
    take_picture(page)
    expect(tile).to_have_attribute("data-face", "good")
    assert real.visit()["slots"]["R-centre"]["reason"] is None


def test_not_possible_for_last_slot_offers_finish(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    for slot in SLOTS:
        expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("aria-current", "step")
        after_debounce(page).locator("#not-possible").focus()
        page.keyboard.press("Enter")
        page.locator("[data-reason=still]").focus()
        after_debounce(page).keyboard.press("Enter")
        expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("data-face", "not_possible")
    expect(page.locator("#not-possible")).to_have_count(0)
    expect(page.locator("#finish.primary")).to_have_text("Finish")
    assert real.visit()["finished_at"] is None
    tap(page, "#finish")
    page.wait_for_selector("[data-outcome=refer_picture]")
    expect(page.locator(".reasons li")).to_have_count(4)


LOADED_AFTER_FINISH = r"""() => {
  const answers = performance.getEntriesByType("resource");
  const finish = answers.findLast(({ name }) => name.endsWith("/finish"));
  return answers.some(({ name, startTime }) => /visits\/[^/]+$/.test(name) && startTime >= finish?.responseEnd);
}"""


def finished(open_page: Open, real: Real, size: tuple[int, int] = (1280, 800)) -> Page:
    """Open a finished visit with one picture."""
    page = aiming(open_page, real, size)
    take_picture(page)
    finish_early(page)
    page.wait_for_selector("#done")
    return page


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_finished_visit_is_read_only_until_reopened(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    page = finished(open_page, real, size)
    expect(page.locator("#reopen")).to_have_text("Change this visit")
    expect(page.locator("[data-slot='R-nerve']")).to_be_disabled()
    assert look_for_faults(page, "#done") == []
    tap(page, "[data-slot='R-centre']")
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.locator(".actions button")).to_have_count(1)
    expect(page.locator("#finish, #again, #next, #other-eye")).to_have_count(0)
    assert look_for_faults(page, "#result") == []
    after_debounce(page).keyboard.press("r")
    expect(page.locator("#done")).to_be_visible()
    for there in ("aim/R-nerve", "patient"):
        page.goto(f"{real.url}/#/visit/{visit_of(page)}/{there}")
        expect(page.locator("#done")).to_be_visible()
    assert real.presses == 1
    tap(page, "#reopen")
    assert look_for_faults(page, "#done") == []
    tap(page, "[data-reason=answer]")
    wait_for_preview(page)
    assert real.visit()["finished_at"] is None
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/pictures")
    tap(page, "#changes")
    expect(page.locator(".changes li").last).to_contain_text("An answer is wrong")
    assert look_for_faults(page) == []


def test_visit_of_earlier_day_cannot_be_reopened(open_page: Open, real: Real) -> None:
    page = finished(open_page, real)
    real.clock.advance(DAY_S)
    page.reload()
    page.wait_for_selector("#done")
    expect(page.locator("#reopen")).to_have_count(0)
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/pictures")
    page.wait_for_selector(".pictures li")
    expect(page.locator("#reopen")).to_have_count(0)


def test_error_alert_is_cleared_on_screen_change(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("409")
    page = finished(open_page, real)
    # The outcome screen loads the finished visit once more; after the jump it would take the button away.
    page.wait_for_function(LOADED_AFTER_FINISH)
    real.clock.advance(DAY_S)
    tap(page, "#reopen")
    tap(page, "[data-reason=answer]")
    expect(page.locator(".state-bar")).to_contain_text("was finished on an earlier day")
    tap(page, "#done")
    page.wait_for_selector("#new")
    expect(page.locator(".state-bar")).to_have_count(0)


def test_light_limit_offers_other_eye_only_during_exam(open_page: Open, real: Real) -> None:
    CAUSES["light.limit"](real, "")
    real.wait_for_problem("light.limit")
    page = open_page(real.url)
    expect(page.locator(".state-bar")).to_contain_text(re.compile(r"Wait \d+ minutes"))
    expect(page.locator("[data-do=otherEye]")).to_have_count(0)


def test_picture_is_moved_to_other_eye_and_back(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    tap(page, "#open-details")
    expect(page.locator("#other-eye")).to_have_text("This is the left eye")
    assert look_for_faults(page) == []
    tap(page, "#other-eye")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "empty")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("aria-current", "step")
    expect(page.locator("#details")).to_be_hidden()
    tap(page, "#open-details")
    tap(page, "#other-eye")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    assert real.rig.store.captures(1)[0].eye == "OD"


def test_fast_tapping_on_real_server(open_page: Open, server: Server, complaints: Complaints) -> None:
    complaints.expect("409", "423")
    page = open_page(server.url)
    page.set_default_timeout(60_000)
    page.locator(".state[data-state=aim]").wait_for(state="attached", timeout=300_000)
    wait_for_release(page)
    new_person(page)
    for _ in range(12):  # a busy computer may cut the light: the slot is then requested again
        tap(page, f"{SHUTTER}[aria-disabled=false]")
        page.wait_for_selector("[data-phase=assessed], [data-phase=kept], .state-bar")
        if page.locator(".state-bar, [data-screen=aim]").count():
            continue
        stay(page)
        if page.locator("[data-slot][data-face=empty]").count() == 0:
            break
        tap(page, "#next")
    tap(page, "#next[aria-disabled=false]")  # its text is Finish when all slots are taken
    page.wait_for_selector("[data-outcome=send]")
    expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
