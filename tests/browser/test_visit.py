"""Whole visits, and interruptions: reload, lost connection, another screen, missing consent."""

import io
import re
from datetime import timedelta

import numpy as np
import pytest
import zxingcpp
from PIL import Image
from playwright.sync_api import Page, Route, expect

from services.records.programme import load_programme
from tests.browser.conftest import Complaints, MakeReal
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Real
from tests.browser.walk import (
    SHUTTER,
    UNSEEN_MS,
    Open,
    after_debounce,
    agree,
    aiming,
    expect_to_stay,
    finish_early,
    new_person,
    stay,
    take_picture,
    tap,
    visit_of,
    wait_for_preview,
)
from tests.journey.conftest import until

pytestmark = pytest.mark.browser


def test_home_continues_an_unfinished_visit_of_yesterday(open_page: Open, real: Real) -> None:
    real.clock.moved = timedelta(days=-1)
    visit = real.begin_visit(consent="agreed", sex="woman", age=54)
    real.clock.moved = timedelta(0)
    page = open_page(f"{real.url}/#/")
    expect(page.locator("#continue")).to_contain_text(re.compile(r"\d{4}"))  # with its day
    expect(page.locator(".home .day")).to_contain_text("0 not finished")  # of today
    assert look_for_faults(page, "#continue") == []
    tap(page, "#continue")
    page.wait_for_url(re.compile(visit["id"]))
    page.goto(f"{real.url}/#/")
    real.begin_visit(consent="agreed")
    page.reload()
    expect(page.locator(".home .day")).to_contain_text("1 not finished")
    expect(page.locator("#continue")).not_to_contain_text("·")


def screen(page: Page) -> str:
    return page.locator(".page").get_attribute("data-screen") or ""


def expect_face(page: Page, slot: str, face: str) -> None:
    """Check the state that a slot's tile shows: good, poor, making, not_possible or empty."""
    expect(page.locator(f".tiles [data-slot='{slot}']")).to_have_attribute("data-face", face)


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_visit_with_retake_and_not_possible(open_page: Open, real: Real, size: tuple[int, int]) -> None:
    page = open_page(real.url, size)
    page.wait_for_selector("#new")
    faults = {"home": look_for_faults(page, "#new")}
    new_person(page)
    page.wait_for_selector(".prompt[data-tone=ready]")  # another hint may be longer
    faults["aim"] = look_for_faults(page, SHUTTER)
    real.hold = "expose"
    place = page.locator(".stage").bounding_box()
    tap(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=making]")
    faults["making"] = look_for_faults(page, SHUTTER)
    real.hold = "quick"
    page.wait_for_selector("[data-phase=assessed] .stage[data-mark=quick]")
    assert page.locator(".stage").bounding_box() == place, "the picture moved when the quick look came"
    faults["assessed"] = look_for_faults(page, "#next", "#again")
    real.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    faults["result"] = look_for_faults(page, "#next", "#again")
    assert page.locator(".stage").bounding_box() == place, "the picture moved when the final one came"
    expect(page.locator("#result-title")).to_have_text("Good")
    page.get_by_role("button", name="Menu").tap()
    faults["menu"] = look_for_faults(page)
    page.keyboard.press("Escape")
    expect_face(page, "R-centre", "good")
    tap(page, "#next")

    expect(page.locator(SHUTTER)).to_contain_text("Optic disc")
    with real.poor_light("saturated"):
        take_picture(page)
    expect(page.locator(".card")).to_contain_text("Too bright. Move back a little. Take again.")
    expect_face(page, "R-nerve", "poor")
    assert page.locator("[data-slot='R-nerve'] img").count() == 1
    tap(page, "#again")
    take_picture(page)
    expect_face(page, "R-nerve", "good")
    tap(page, "#next")

    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    real.show("saturated")
    for _ in range(2):
        take_picture(page)
        assert page.locator("#not-possible").count() == 0
        tap(page, "#again")
    take_picture(page)
    real.show(None)
    expect(page.locator(".card")).to_contain_text("Not clear after 3 tries. Choose “Not possible”.")
    tap(page, "#not-possible")
    faults["why"] = look_for_faults(page)
    tap(page, "[data-reason=pupil]")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Optic disc")
    expect_face(page, "L-centre", "not_possible")

    take_picture(page)
    expect(page.locator("#next")).to_contain_text("Finish")
    tap(page, "#next")
    expect(page.locator(".outcome .verdict")).to_contain_text("Refer")
    expect(page.locator(".reasons")).to_have_text(re.compile("Left eye · .*: Small pupil"))
    faults["outcome"] = look_for_faults(page, "#done")
    visit = real.visit()
    assert len(visit["slots"]["L-centre"]["captures"]) == 3, "every try is kept"
    assert real.presses == 7
    tap(page, "#done")
    expect(page.locator(".day")).to_contain_text("1 done")
    assert faults == {name: [] for name in faults}


def test_new_patient_needs_two_taps_and_no_typing(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    for selector in ("#new", "[data-value=agreed]"):
        tap(page, selector)
    wait_for_preview(page)
    page.wait_for_timeout(UNSEEN_MS)
    tap(page, "#who")
    for field, value in (("sex", "woman"), ("diabetes", "yes"), ("diabetes_years", ">10"), ("vision_os", "CF")):
        page.locator(f"[data-field={field}] [data-value='{value}']").tap()
    page.locator(".question [data-key='5']").tap()
    page.locator(".question [data-key='4']").tap()
    page.locator("[data-field=complaints] [data-value=flashes]").tap()
    page.locator("[data-field=complaints] [data-value=none]").tap()
    expect(page.locator("h1")).to_have_text("A0001-3 · Woman, 54")
    answers = {
        "consent": "agreed",
        "sex": "woman",
        "diabetes": "yes",
        "diabetes_years": ">10",
        "vision_os": "CF",
        "age": 54,
        "complaints": ["none"],
    }
    until(lambda: real.visit()["fields"] == answers)  # the last answer may still be on its way
    expect(page.locator("#unsaved")).to_be_empty()


def test_urgent_complaint_shows_warning(open_page: Open, real: Real) -> None:
    visit = real.begin_visit()["id"]
    page = open_page(f"{real.url}/#/visit/{visit}/patient")
    page.locator("[data-value=sudden_loss]").tap()
    expect(page.locator(".urgent")).to_have_text("See the doctor today.")


def test_visit_without_consent_can_only_be_finished(open_page: Open, real: Real) -> None:
    visit = real.begin_visit()
    page = open_page(f"{real.url}/#/visit/{visit['id']}/aim/R-centre")
    expect(page.locator(".state-bar[data-code='consent.missing']")).to_contain_text("Ask the patient first.")
    after_debounce(page).locator(SHUTTER).tap(force=True)
    expect(page.locator(SHUTTER)).to_contain_text("Ask the patient first")
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)
    assert look_for_faults(page) == []
    tap(page, "[data-do=ask]")
    page.locator("[data-value=declined]").tap()
    tap(page, "#finish")
    expect(page.locator(".outcome")).to_have_attribute("data-outcome", "declined")
    assert real.visit()["outcome"]["code"] == "declined"
    assert real.presses == 0
    tap(page, "#done")
    expect(page.locator(".day")).to_contain_text(re.compile("1 done.*0 referred.*1 did not agree", re.DOTALL))


def test_finish_asks_when_a_picture_is_missing(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    tap(page, "#finish")
    expect(page.locator("#finish-question h2")).to_have_text("3 pictures are missing. Finish without them?")
    assert real.visit()["finished_at"] is None
    assert look_for_faults(page) == []
    page.locator("#take-missing").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Optic disc")
    tap(page, "#finish")
    page.locator("#finish-without").tap()
    page.wait_for_selector(".outcome .verdict")
    expect(page.locator("#outcome-title")).to_be_focused()
    after_debounce(page).keyboard.press("Enter")
    expect(page.locator("#outcome-title")).to_be_visible()  # a second press of a wireless shutter leaves nothing
    assert real.visit()["finished_at"] is not None


def test_a_refused_field_is_shown_with_the_number_that_the_server_sent(
    open_page: Open, real: Real, complaints: Complaints
) -> None:
    complaints.expect("423")
    visit = real.begin_visit()["id"]
    page = after_debounce(open_page(f"{real.url}/#/visit/{visit}/patient"))
    refusal = {"code": "light.limit", "message": "the limit of light is reached", "n": 4}

    def refuse(route: Route) -> None:
        if route.request.method == "PATCH":
            route.fulfill(status=423, json=refusal)
        else:
            route.fallback()

    page.route(f"**/api/visits/{visit}", refuse)
    page.locator("[data-value=man]").tap()
    expect(page.locator(".state-bar")).to_contain_text("Wait 4 minutes with this eye.")
    expect(page.locator("[data-value=man]")).to_have_attribute("aria-pressed", "false")


def test_unsaved_fields_are_resent_after_reconnection(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("ERR_INTERNET_DISCONNECTED", "ERR_FAILED")
    visit = real.begin_visit()["id"]
    page = after_debounce(open_page(f"{real.url}/#/visit/{visit}/patient"))
    page.route(f"**/api/visits/{visit}", lambda route: route.abort())
    page.locator("[data-value=man]").tap()
    expect(page.locator("#unsaved")).to_be_visible()
    expect(page.locator("[data-value=man]")).to_have_attribute("aria-pressed", "true")
    page.unroute(f"**/api/visits/{visit}")
    page.locator("[data-value=agreed]").tap()
    wait_for_preview(page)
    page.wait_for_timeout(UNSEEN_MS)
    tap(page, "#who")
    expect(page.locator("#unsaved")).to_be_empty()
    assert real.visit()["fields"] == {"sex": "man", "consent": "agreed"}


def test_next_press_is_allowed_after_verdict(open_page: Open, real: Real) -> None:
    real.hold = "stored"
    page = aiming(open_page, real)
    page.locator(SHUTTER).tap()
    page.wait_for_selector("[data-phase=assessed]")
    expect(page.locator(".card")).to_contain_text("Sharp and bright enough.")
    expect(page.locator("progress")).to_be_visible()
    tap(page, "#next")
    expect_face(page, "R-centre", "making")
    tap(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=assessed]")
    assert real.presses == 2
    real.hold = None
    page.wait_for_selector("[data-slot='R-centre'][data-face=good]")
    expect(page.locator("[data-slot='R-nerve']")).to_have_attribute("aria-current", "step")


def test_poor_picture_is_kept_and_older_one_selected(open_page: Open, real: Real) -> None:
    real.show("saturated")
    page = aiming(open_page, real)
    take_picture(page)
    tap(page, "#again")
    take_picture(page)
    tap(page, "#keep")
    expect(page.locator(SHUTTER)).to_contain_text("Optic disc")
    first, second = real.visit()["slots"]["R-centre"]["captures"]
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/picture/R-centre/{first}")
    tap(page, "#use")
    expect(page.locator("#use")).to_have_count(0)
    assert real.visit()["slots"]["R-centre"]["capture"] == first != second


def test_laterality_question_moves_picture(open_page: Open, make_real: MakeReal) -> None:
    real = make_real(binning=4)
    real.rig.world.faults.add("eye.other")
    page = aiming(open_page, real)
    tap(page, SHUTTER)
    expect_to_stay(page)
    real.publish_alerts()
    expect(page.locator(".ask")).to_contain_text("This looks like the left eye. Change it?")
    page.locator("[data-do=change]").tap()
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "empty")


def test_confirmed_eye_is_not_asked_again(open_page: Open, make_real: MakeReal) -> None:
    real = make_real(binning=4)
    real.rig.world.faults.add("eye.other")
    page = aiming(open_page, real)
    take_picture(page)
    real.publish_alerts()
    expect(page.locator(".ask")).to_be_visible()
    with page.expect_request("**/eye") as sent:
        page.locator("[data-do=keepEye]").tap()
    assert sent.value.post_data_json["eye"] == "OD"
    expect(page.locator(".ask")).to_have_count(0)
    real.publish_alerts()
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator(".ask")).to_have_count(0)


def test_finished_visit_is_reopened_and_qr_code_has_no_name(open_page: Open, make_real: MakeReal) -> None:
    programme = load_programme()
    where = {"en": "Eye clinic, District Hospital", "ta": "கண் மருத்துவமனை"}
    referral = programme.referral.model_copy(update={"centre_phone": "+91 44 5550 0142", "where": where})
    letter = programme.letter.model_copy(update={"name": "Village Eye Programme"})
    real = make_real(programme=programme.model_copy(update={"referral": referral, "letter": letter}))
    visit = real.begin_visit(consent="agreed", name="Lakshmi", vision_od="6/60", vision_os="6/9")
    for slot in ("R-centre", "R-nerve", "L-centre"):
        real.press(visit["id"], slot)
    page = open_page(f"{real.url}/#/visit/{visit['id']}/aim/L-nerve")
    wait_for_preview(page)
    finish_early(after_debounce(page))
    page.locator("#code").tap()
    page.wait_for_selector(".outcome > figure.code svg path")
    decoded = qr_text(page)
    assert decoded.split("\n")[0] == visit["number"]
    assert decoded.split("\n")[2:] == ["refer_vision", "+91 44 5550 0142"]
    assert "Lakshmi" not in decoded
    page.emulate_media(media="print")
    expect(page.locator(".slip")).to_be_visible()
    expect(page.locator("header")).to_be_hidden()
    expect(page.locator(".slip")).not_to_contain_text("Lakshmi")
    for words in ("Village Eye Programme", "6/60", "6/9", "not taken", "Go by", "Eye clinic", "Centre: +91"):
        expect(page.locator(".slip")).to_contain_text(words)
    page.emulate_media(media="screen")
    tap(page, "#reopen")
    tap(page, "[data-reason=mistake]")
    wait_for_preview(page)
    assert real.visit()["finished_at"] is None


def qr_text(page: Page) -> str:
    picture = Image.open(io.BytesIO(page.locator(".outcome > figure.code svg").screenshot())).convert("L")
    return str(zxingcpp.read_barcodes(np.asarray(picture))[0].text)


def test_reload_restores_every_screen(open_page: Open, real: Real) -> None:
    page = open_page(real.url)

    def reloaded(expected: str, mark: str) -> None:
        page.reload()
        page.wait_for_selector(mark)
        assert screen(page) == expected

    tap(page, "#find")
    page.wait_for_selector(".find")
    reloaded("find", ".pad")
    tap(page, "#back")
    tap(page, "#new")
    page.wait_for_selector(".patient")
    reloaded("patient", "[data-value=agreed]")
    agree(page)
    reloaded("aim", "eye-live[data-frame]")
    take_picture(page)
    reloaded("picture", ".stage[data-mark=final]")
    expect(page.locator("#result-title")).to_have_text("Good")
    finish_early(page)
    page.wait_for_selector(".outcome .verdict")
    reloaded("outcome", ".outcome .verdict")
    tap(page, "#done")
    tap(page, "#history")
    reloaded("history", "[data-visit]")
    tap(page, "[data-visit]")
    page.wait_for_selector(".pictures li")
    reloaded("pictures", ".pictures li")


def test_reload_during_capture_waits_for_result(open_page: Open, real: Real) -> None:
    real.hold = "quick"
    page = aiming(open_page, real)
    page.locator(SHUTTER).tap()
    page.wait_for_selector(".stage[data-mark=quick]")
    page.reload()
    page.wait_for_selector("[data-phase=making]")
    real.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    assert real.presses == 1


def test_back_is_one_step(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    new_person(page)
    take_picture(page)
    steps = []
    for _ in range(3):
        page.go_back()
        page.wait_for_timeout(100)
        steps.append(screen(page))
    assert steps == ["aim", "patient", "home"]
    page.go_forward()
    page.wait_for_selector(".patient")
    tap(page, "#back")
    page.wait_for_selector("#new")


def test_find_by_number_and_compare_two_pictures(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    for _ in range(2):
        take_picture(page)
        tap(page, "#again")
    page.goto(f"{real.url}/#/find")
    after_debounce(page)
    for key in "0013":
        page.locator(f"[data-key='{key}']").tap()
    tap(page, "[data-visit]")
    page.wait_for_selector("[data-screen=aim]")
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/pictures")
    page.wait_for_selector(".pick")
    for pick in page.locator(".pick").all():
        pick.tap()
    tap(page, "#compare")
    pics = page.locator(".two eye-pic")
    for i in (0, 1):
        expect(pics.nth(i)).to_have_attribute("data-drawn", re.compile("^final"))
    pics.nth(0).press("+")
    expect(pics.nth(1)).to_have_attribute("data-zoom", "1.50")
    assert look_for_faults(page) == []
    page.locator("[data-value=true]").tap()
    expect(pics.nth(1)).to_be_hidden()
    page.locator("#swap").tap()
    expect(pics.nth(0)).to_be_hidden()


def test_visit_is_copied_to_usb_and_saved_as_zip(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    visit = visit_of(page)
    real.mount()
    page.goto(f"{real.url}/#/visit/{visit}/pictures")
    tap(page, "#copy")
    page.locator("[data-folder]").tap()
    expect(page.get_by_role("note")).to_contain_text("Copied to USB STICK.")
    expect(page.get_by_role("link", name="ZIP")).to_have_attribute("href", f"/api/visits/{visit}/export.zip")
    name = {"content-disposition": 'attachment; filename="visit.zip"'}
    page.route("**/export.zip", lambda route: route.fulfill(body=b"PK", headers=name))
    with page.expect_download():
        page.get_by_role("link", name="ZIP").tap()
    expect(page.get_by_role("note")).to_contain_text("in this tablet’s Downloads")


def test_control_is_taken_from_another_screen(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect(r"409 .*/api/preview")  # the next live picture of the first screen
    first = aiming(open_page, real)
    second = after_debounce(open_page(f"{real.url}/#/visit/{visit_of(first)}/aim/R-centre"))
    expect(second.locator(SHUTTER)).to_contain_text("Other tablet")
    second.locator("[data-do=useHere]").tap()
    expect(second.locator(SHUTTER)).to_contain_text("Take picture")
    expect(first.locator(SHUTTER)).to_contain_text("Other tablet")
    expect(first.locator("eye-live[data-frame]")).to_have_count(0)


def test_markup_is_shown_as_text(open_page: Open, real: Real) -> None:
    evil = "<img src=x onerror=alert(1)>" * 3
    visit = real.begin_visit(consent="agreed", sex="woman") | {"number": evil}
    page = open_page("about:blank", SIZES["phone"])  # a server that accepts no such number would not send it
    page.route(f"**/api/visits/{visit['id']}", lambda route: route.fulfill(json=visit))
    page.goto(f"{real.url}/#/visit/{visit['id']}/patient")
    expect(page.locator("h1")).to_contain_text("<img src=x onerror=alert(1)>")
    assert page.locator("img").count() == 0
    assert look_for_faults(page) == []


def test_visit_by_shortcut_keys(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    page.locator("h2").first.click()
    with real.poor_light("saturated"):
        page.keyboard.press("Space")
        page.wait_for_selector(".stage[data-mark=final]")
    after_debounce(page).keyboard.press("r")
    page.wait_for_selector("[data-screen=aim]")
    after_debounce(page).keyboard.press("Enter")
    stay(page)
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    after_debounce(page).keyboard.press("n")
    expect(page.locator(SHUTTER)).to_contain_text("Optic disc")
    page.keyboard.press("4")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Optic disc")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("[data-screen=patient]")
    page.keyboard.press("?")
    expect(page.locator("#menu")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#menu")).to_be_hidden()
    assert real.presses == 2


def test_automatic_capture_when_ready(open_page: Open, real: Real) -> None:
    real.show("pupil")
    page = aiming(open_page, real)
    page.get_by_role("button", name="Menu").tap()
    page.locator("#auto").check()
    page.get_by_role("button", name="Close").tap()
    expect(page.get_by_role("status")).to_contain_text("Move back a little")
    page.wait_for_timeout(1500)
    assert real.presses == 0
    real.show(None)
    page.wait_for_selector("[data-screen=picture]")
    assert real.presses == 1


def test_finish_while_the_visit_is_loading_ends_nothing(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    held: list[Route] = []
    page.route("**/api/visits/*", lambda route: held.append(route))  # never answered
    page.reload()
    after_debounce(page).locator("#finish").tap()
    expect(page.locator("#finish")).to_have_text("Finish without the missing pictures")
    after_debounce(page)
    assert held, "it is still loading"
    assert real.visit()["finished_at"] is None
