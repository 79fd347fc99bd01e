"""A whole visit as a health worker does it, and everything that can interrupt one, with the stand-in for the API."""

import io

import numpy as np
import pytest
import zxingcpp
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.conftest import Complaints
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, live, new_person, settled, taken, tap

pytestmark = pytest.mark.browser


def screen(page: Page) -> str:
    return page.locator(".page").get_attribute("data-screen") or ""


def expect_face(page: Page, slot: str, face: str) -> None:
    """What the tile of a slot shows: good, poor, making, could_not or empty."""
    expect(page.locator(f".tiles [data-slot='{slot}']")).to_have_attribute("data-face", face)


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_a_whole_visit_with_a_retake_and_a_could_not(open_page: Open, stub: Stubbed, size: tuple[int, int]) -> None:
    stub.stub.expose_s, stub.stub.refine_s = 0.02, 0.1
    stub.stub.verdicts = [None, "shot.moved", None, "shot.pupil", "shot.dark", "shot.pupil", None]
    page = open_page(stub.url, size)
    page.wait_for_selector("#new")
    faults = {"home": look_for_faults(page, "#new")}
    new_person(page)
    faults["aim"] = look_for_faults(page, SHUTTER)
    stub.stub.hold = "verdict"
    place = page.locator(".stage").bounding_box()
    tap(page, SHUTTER)
    page.wait_for_selector(".stage[data-mark=quick]")
    faults["making"] = look_for_faults(page, SHUTTER)
    assert page.locator(".stage").bounding_box() == place, "the picture moved when the quick look came"
    stub.stub.hold = "keep"
    page.wait_for_selector("[data-phase=told]")
    faults["told"] = look_for_faults(page, "#next", "#again")
    stub.stub.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    faults["result"] = look_for_faults(page, "#next", "#again")
    assert page.locator(".stage").bounding_box() == place, "the picture moved when the final one came"
    expect(page.locator("#result-title")).to_have_text("Good")
    page.get_by_role("button", name="Menu").tap()
    faults["menu"] = look_for_faults(page)
    page.keyboard.press("Escape")
    expect_face(page, "R-centre", "good")
    tap(page, "#next")

    expect(page.locator(SHUTTER)).to_contain_text("Nerve")
    taken(page)
    expect(page.locator(".card")).to_contain_text("It moved. Rest your hand on the cheek.")
    expect_face(page, "R-nerve", "poor")
    assert page.locator("[data-slot='R-nerve'] img").count() == 1
    tap(page, "#again")
    taken(page)
    expect_face(page, "R-nerve", "good")
    tap(page, "#next")

    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    for _ in range(2):
        taken(page)
        assert page.locator("#could-not").count() == 0
        tap(page, "#again")
    taken(page)
    expect(page.locator(".card")).to_contain_text("Not clear after 3 tries. That is useful to know.")
    tap(page, "#could-not")
    faults["why"] = look_for_faults(page)
    tap(page, "[data-reason=pupil]")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Nerve")
    expect_face(page, "L-centre", "could_not")

    taken(page)
    expect(page.locator("#next")).to_contain_text("Finish")
    tap(page, "#next")
    expect(page.locator(".outcome .verdict")).to_contain_text("Refer: picture not possible")
    faults["outcome"] = look_for_faults(page, "#done")
    visit = next(iter(stub.stub.visits.kept.values()))
    assert len(visit["slots"]["L-centre"]["captures"]) == 3, "every try is kept"
    assert stub.stub.presses == 7
    tap(page, "#done")
    expect(page.locator(".day")).to_contain_text("1 done")
    assert faults == {name: [] for name in faults}


def test_a_new_person_is_three_taps_from_the_live_picture_and_typing_is_never_needed(
    open_page: Open, stub: Stubbed
) -> None:
    page = open_page(stub.url)
    for selector in ("#new", "[data-value=agreed]", "#shoot"):
        tap(page, selector)
    live(page)
    tap(page, "#who")
    for field, value in (("sex", "woman"), ("diabetes", "yes"), ("diabetes_years", ">10"), ("vision_os", "CF")):
        page.locator(f"[data-field={field}] [data-value='{value}']").tap()
    page.locator(".question [data-key='5']").tap()
    page.locator(".question [data-key='4']").tap()
    page.locator("[data-field=complaints] [data-value=flashes]").tap()
    page.locator("[data-field=complaints] [data-value=none]").tap()
    expect(page.locator("h1")).to_have_text("A0142 · Woman, 54")
    fields = next(iter(stub.stub.visits.kept.values()))["fields"]
    expect(page.locator("#unsaved")).to_have_count(0)
    assert fields == {"consent": "agreed", "sex": "woman", "diabetes": "yes", "diabetes_years": ">10",
                      "vision_os": "CF", "age": 54, "complaints": ["none"]}  # fmt: skip


def test_an_urgent_complaint_is_told_at_once(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin()
    page = open_page(f"{stub.url}/#/visit/v142/person")
    page.locator("[data-value=sudden_loss]").tap()
    expect(page.locator(".urgent")).to_have_text("See the doctor today.")


def test_without_consent_there_is_no_shutter_and_a_visit_still_ends(open_page: Open, stub: Stubbed) -> None:
    visit = stub.stub.visits.begin()
    page = open_page(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre")
    expect(page.locator(".state-bar[data-code='consent.missing']")).to_contain_text("First ask: may we take pictures?")
    settled(page).locator(SHUTTER).tap(force=True)
    expect(page.locator(SHUTTER)).to_contain_text("First ask")
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)
    assert look_for_faults(page) == []
    tap(page, "[data-do=ask]")
    page.locator("[data-value=declined]").tap()
    tap(page, "#finish")
    expect(page.locator(".outcome")).to_be_visible()
    assert stub.stub.presses == 0


def test_what_cannot_be_sent_is_kept_and_sent_when_the_link_is_back(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("ERR_INTERNET_DISCONNECTED", "ERR_FAILED")
    stub.stub.visits.begin()
    page = settled(open_page(f"{stub.url}/#/visit/v142/person"))
    page.route("**/api/visits/v142", lambda route: route.abort())
    page.locator("[data-value=man]").tap()
    expect(page.locator("#unsaved")).to_be_visible()
    expect(page.locator("[data-value=man]")).to_have_attribute("aria-pressed", "true")
    page.unroute("**/api/visits/v142")
    page.locator("[data-value=agreed]").tap()
    expect(page.locator("#unsaved")).to_have_count(0)
    assert stub.stub.patched == [("sex", "man"), ("consent", "agreed")]


def test_the_verdict_comes_before_the_picture_and_the_next_press_need_not_wait(open_page: Open, stub: Stubbed) -> None:
    stub.stub.hold = "keep"
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    page.wait_for_selector("[data-phase=told]")
    expect(page.locator(".card")).to_contain_text("You can go on.")
    expect(page.locator("progress")).to_be_visible()
    tap(page, "#next")
    expect_face(page, "R-centre", "making")
    tap(page, SHUTTER)
    page.wait_for_selector("[data-phase=told]")
    assert stub.stub.presses == 2
    stub.stub.hold = None
    page.wait_for_selector("[data-slot='R-centre'][data-face=good]")
    expect(page.locator("[data-slot='R-nerve']")).to_have_attribute("aria-current", "step")


def test_a_poor_picture_can_be_kept_and_an_older_one_can_be_used(open_page: Open, stub: Stubbed) -> None:
    stub.stub.verdicts = ["shot.edge", "shot.halo"]
    page = aiming(open_page, stub)
    taken(page)
    tap(page, "#again")
    taken(page)
    tap(page, "#keep")
    expect(page.locator(SHUTTER)).to_contain_text("Nerve")
    first, second = next(iter(stub.stub.visits.kept.values()))["slots"]["R-centre"]["captures"]
    page.goto(f"{stub.url}/#/visit/v142/picture/R-centre/{first}")
    tap(page, "#use")
    expect(page.locator("#use")).to_have_count(0)
    assert stub.stub.visits.kept["v142"]["slots"]["R-centre"]["capture"] == first != second


def test_the_wrong_eye_is_asked_about_and_changed_by_one_tap(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    name = stub.stub.captures[0]["id"]
    stub.stub.tell("notice", {"code": "eye.side", "id": name, "slot": "R-centre", "other": "OS"})
    expect(page.locator(".ask")).to_contain_text("This looks like the left eye. Change it?")
    page.locator("[data-do=change]").tap()
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "empty")


def test_who_keeps_the_eye_says_so_to_the_instrument_and_is_not_asked_again(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    asked = {"code": "eye.side", "id": stub.stub.captures[0]["id"], "slot": "R-centre", "other": "OS"}
    stub.stub.tell("notice", asked)
    expect(page.locator(".ask")).to_be_visible()
    with page.expect_request("**/eye") as sent:
        page.locator("[data-do=keepEye]").tap()
    assert sent.value.post_data_json["eye"] == "OD"
    expect(page.locator(".ask")).to_have_count(0)
    stub.stub.tell("notice", asked)  # of before it heard the answer
    stub.stub.tell("notice", {"code": "eye.side", "over": True})
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator(".ask")).to_have_count(0)


def test_a_finished_visit_can_be_opened_again_and_the_code_holds_no_name(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin(consent="agreed", name="Lakshmi")
    page = settled(open_page(f"{stub.url}/#/visit/v142/aim/R-centre"))
    tap(page, "#finish")
    page.locator("#code").tap()
    page.wait_for_selector("figure.code svg path")
    decoded = qr_text(page)
    assert decoded.split("\n")[0] == "A0142"
    assert decoded.split("\n")[2:] == ["send", "+91 44 5550 0142"]
    assert "Lakshmi" not in decoded
    page.emulate_media(media="print")
    expect(page.locator(".slip")).to_be_visible()
    expect(page.locator("header")).to_be_hidden()
    expect(page.locator(".slip")).not_to_contain_text("Lakshmi")
    page.emulate_media(media="screen")
    tap(page, "#reopen")
    live(page)
    assert stub.stub.visits.kept["v142"]["finished_at"] is None


def qr_text(page: Page) -> str:
    picture = Image.open(io.BytesIO(page.locator(".outcome > figure.code svg").screenshot())).convert("L")
    return str(zxingcpp.read_barcodes(np.asarray(picture))[0].text)


def test_a_reload_at_every_screen_comes_back_where_it_was(open_page: Open, stub: Stubbed) -> None:
    page = open_page(stub.url)

    def reloaded(expected: str, mark: str) -> None:
        page.reload()
        page.wait_for_selector(mark)
        assert screen(page) == expected

    tap(page, "#find")
    page.wait_for_selector(".find")
    reloaded("find", ".pad")
    tap(page, "#back")
    tap(page, "#new")
    page.wait_for_selector(".person")
    reloaded("person", "[data-value=agreed]")
    tap(page, "[data-value=agreed]")
    tap(page, "#shoot")
    live(page)
    reloaded("aim", "eye-live[data-frame]")
    taken(page)
    reloaded("picture", ".stage[data-mark=final]")
    expect(page.locator("#result-title")).to_have_text("Good")
    tap(page, "#finish")
    page.wait_for_selector(".outcome .verdict")
    reloaded("outcome", ".outcome .verdict")
    tap(page, "#done")
    tap(page, "#history")
    reloaded("history", "[data-visit]")
    tap(page, "[data-visit]")
    page.wait_for_selector(".film li")
    reloaded("film", ".film li")


def test_a_reload_while_the_picture_is_made_waits_for_it(open_page: Open, stub: Stubbed) -> None:
    stub.stub.hold = "verdict"
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    page.wait_for_selector(".stage[data-mark=quick]")
    page.reload()
    page.wait_for_selector("[data-phase=making]")
    stub.stub.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    assert stub.stub.presses == 1


def test_back_is_one_step(open_page: Open, stub: Stubbed) -> None:
    page = open_page(stub.url)
    new_person(page)
    taken(page)
    steps = []
    for _ in range(3):
        page.go_back()
        page.wait_for_timeout(100)
        steps.append(screen(page))
    assert steps == ["aim", "person", "home"]
    page.go_forward()
    page.wait_for_selector(".person")
    tap(page, "#back")
    page.wait_for_selector("#new")


def test_numbers_find_a_person_and_history_compares_two_pictures(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    for _ in range(2):
        taken(page)
        tap(page, "#again")
    page.goto(f"{stub.url}/#/find")
    settled(page)
    for key in "142":
        page.locator(f"[data-key='{key}']").tap()
    tap(page, "[data-visit=v142]")
    page.wait_for_selector("[data-screen=aim]")
    page.goto(f"{stub.url}/#/visit/v142/film")
    page.wait_for_selector(".pick")
    for pick in page.locator(".pick").all():
        pick.tap()
    tap(page, "#compare")
    pics = page.locator(".two eye-pic")
    expect(pics.nth(1)).to_have_attribute("data-mark", "final")
    pics.nth(0).focus()
    page.keyboard.press("+")
    expect(pics.nth(1)).to_have_attribute("data-zoom", "1.50")
    assert look_for_faults(page) == []
    page.locator("[data-value=true]").tap()
    expect(pics.nth(1)).to_be_hidden()
    page.locator("#swap").tap()
    expect(pics.nth(0)).to_be_hidden()


def test_a_visit_is_copied_to_a_stick_and_saved_as_a_file(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    page.goto(f"{stub.url}/#/visit/v142/film")
    tap(page, "#copy")
    page.locator("[data-folder='/media/usb-1']").tap()
    expect(page.get_by_role("note")).to_contain_text("Copied to USB stick BLUE.")
    expect(page.get_by_role("link", name="ZIP")).to_have_attribute("href", "/api/visits/v142/export.zip")
    name = {"content-disposition": 'attachment; filename="visit.zip"'}
    page.route("**/export.zip", lambda route: route.fulfill(body=b"PK", headers=name))
    with page.expect_download():
        page.get_by_role("link", name="ZIP").tap()
    expect(page.get_by_role("note")).to_contain_text("Look in its downloads.")


def test_another_screen_holds_the_controls_until_they_are_taken(open_page: Open, stub: Stubbed) -> None:
    first = aiming(open_page, stub)
    second = settled(open_page(f"{stub.url}/#/visit/v142/aim/R-centre"))
    expect(second.locator(SHUTTER)).to_contain_text("Other screen")
    second.locator("[data-do=useHere]").tap()
    expect(second.locator(SHUTTER)).to_contain_text("Take picture")
    expect(first.locator(SHUTTER)).to_contain_text("Other screen", timeout=15_000)


def test_hostile_words_are_only_words(open_page: Open, stub: Stubbed) -> None:
    evil = "<img src=x onerror=alert(1)>" * 3
    stub.stub.visits.begin(number=evil, name=evil, consent="agreed", sex="woman")
    page = open_page(f"{stub.url}/#/visit/v142/person", SIZES["phone"])
    expect(page.locator("h1")).to_contain_text("<img src=x onerror=alert(1)>")
    assert page.locator("img").count() == 0
    assert look_for_faults(page) == []


def test_keys_go_the_whole_way(open_page: Open, stub: Stubbed) -> None:
    stub.stub.verdicts = ["shot.moved"]
    page = aiming(open_page, stub)
    page.locator("h2").first.click()
    page.keyboard.press("Space")
    page.wait_for_selector(".stage[data-mark=final]")
    settled(page).keyboard.press("r")
    page.wait_for_selector("[data-screen=aim]")
    settled(page).keyboard.press("Enter")
    page.wait_for_selector("[data-phase=kept] [data-verdict=good]")
    settled(page).keyboard.press("n")
    expect(page.locator(SHUTTER)).to_contain_text("Nerve")
    page.keyboard.press("4")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Nerve")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("[data-screen=person]")
    page.keyboard.press("?")
    expect(page.locator("#menu")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#menu")).to_be_hidden()
    assert stub.stub.presses == 2


def test_the_picture_takes_itself_when_the_device_says_ready(open_page: Open, stub: Stubbed) -> None:
    stub.stub.aim = {"code": "closer", "fill": 0.4}
    page = aiming(open_page, stub)
    page.get_by_role("button", name="Menu").tap()
    page.locator("#auto").check()
    page.get_by_role("button", name="Close").tap()
    expect(page.get_by_role("status")).to_contain_text("Move a little closer")
    page.wait_for_timeout(1500)
    assert stub.stub.presses == 0
    stub.stub.aim = {"code": "ready", "fill": 0.9}
    page.wait_for_selector("[data-screen=picture]")
    assert stub.stub.presses == 1
