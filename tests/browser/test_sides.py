"""Nothing is lost without a word: fast tapping, pictures that fail, a finish too early, a visit that is closed."""

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Complaints, Server
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, live, new_person, settled, taken, tap

pytestmark = pytest.mark.browser

SLOTS = ["R-centre", "R-nerve", "L-centre", "L-nerve"]
FAST = 3  # visits; a person's fastest tap is half a second after the last


def begin(page: Page, url: str, stub: Stubbed) -> str:
    """Aim at the first picture of another person who agreed."""
    visit = str(stub.stub.visits.begin(consent="agreed")["id"])
    page.goto(f"{url}/#/visit/{visit}/aim/R-centre")
    return visit


def told(page: Page) -> None:
    page.wait_for_selector("[data-phase=told], [data-phase=kept]")


def test_four_pictures_as_fast_as_the_page_allows_are_four_every_time(open_page: Open, stub: Stubbed) -> None:
    stub.stub.expose_s, stub.stub.refine_s = 0.02, 0.5
    page = aiming(open_page, stub)
    for _ in range(FAST):
        visit = begin(page, stub.url, stub)
        for slot in SLOTS:
            expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("aria-current", "step")
            tap(page, f"{SHUTTER}[aria-disabled=false]")
            told(page)
            expect(page.locator("#result-title")).to_have_text("Good")
            expect(page.locator(".prompt")).not_to_contain_text("Hold still")
            expect(page.locator(".state")).not_to_have_text("Taking")
            if slot != SLOTS[-1]:
                tap(page, "#next")
        expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
        slots = stub.stub.visits.kept[visit]["slots"]
        assert [len(slots[slot]["captures"]) for slot in SLOTS] == [1, 1, 1, 1]
    assert stub.stub.presses == 4 * FAST


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_a_good_picture_that_is_lost_after_next_is_told_until_it_is_taken(
    open_page: Open, stub: Stubbed, complaints: Complaints, size: tuple[int, int]
) -> None:
    complaints.expect("507")
    stub.stub.lose, stub.stub.hold = [1], "keep"
    page = aiming(open_page, stub, size)
    page.locator(SHUTTER).tap()
    told(page)
    expect(page.locator("#result-title")).to_have_text("Good")
    tap(page, "#next")
    live(page)
    stub.stub.hold = None
    chip = page.locator("[data-code='shot.lost']")
    expect(chip.get_by_role("alert")).to_have_text("Right eye, Centre: no picture was kept. Please take it again.")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "lost")
    assert look_for_faults(page, SHUTTER) == []
    taken(page)  # the next press does not wipe the words away
    expect(chip).to_be_visible()
    page.locator("[data-do=takeNow]").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Centre")
    taken(page)
    expect(chip).to_have_count(0)
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")


def test_a_light_that_went_out_too_early_leaves_one_on_that_tile(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("423")
    stub.stub.cut = [1]
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    expect(page.locator(".state-bar")).to_contain_text("The light went out too early. Please take it again.")
    expect(page.locator("[data-screen=aim] #shutter")).to_contain_text("Right eye · Centre")
    expect(page.locator("#next")).to_have_count(0)
    taken(page)
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-code='shot.lost'], .state-bar")).to_have_count(0)


def test_an_answer_that_the_link_cut_off_is_asked_for_when_it_is_back(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("ERR_FAILED", "404")
    stub.stub.hold = "keep"
    page = aiming(open_page, stub)
    page.route("**/api/captures", lambda route: route.fetch() and route.abort())
    page.locator(SHUTTER).tap()
    told(page)
    tap(page, "#next")
    stub.stub.lose, stub.stub.hold = [1], None  # the page never hears of it: it must ask
    expect(page.locator("[data-code='shot.lost']")).to_be_visible(timeout=20_000)


def test_a_finish_waits_for_the_picture_in_the_making_and_refers_nobody_falsely(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    stub.stub.hold = "keep"
    tap(page, "[data-slot='L-centre']")
    tap(page, SHUTTER)
    told(page)
    tap(page, "#finish")
    expect(page.locator("#finishing h2")).to_have_text("One picture is still being made")
    expect(page.locator("#finishing progress")).to_be_visible()
    assert look_for_faults(page) == []
    assert stub.stub.visits.kept["v142"]["finished_at"] is None
    stub.stub.hold = None
    expect(page.locator(".outcome .verdict")).to_contain_text("eye specialist")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")


def test_a_picture_that_is_lost_during_the_finish_is_asked_for_again(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
    complaints.expect("507")
    stub.stub.lose, stub.stub.hold = [1], "keep"
    page = aiming(open_page, stub)
    tap(page, SHUTTER)
    told(page)
    tap(page, "#finish")
    page.wait_for_selector("#finishing")
    stub.stub.hold = None
    expect(page.locator("[data-code='shot.lost']")).to_be_visible()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Centre")
    assert stub.stub.visits.kept["v142"]["finished_at"] is None


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_a_tile_can_be_crossed_while_aiming_and_uncrossed(
    open_page: Open, stub: Stubbed, size: tuple[int, int]
) -> None:
    page = aiming(open_page, stub, size)
    assert look_for_faults(page, SHUTTER) == []
    tap(page, "#could-not")
    reasons = page.locator("[data-reason]")
    assert [one.get_attribute("data-reason") for one in reasons.all()][0::6] == ["lids", "other"]
    assert look_for_faults(page) == []
    tap(page, "[data-reason=lids]")
    tile = page.locator("[data-slot='R-centre']")
    expect(tile).to_have_attribute("data-face", "could_not")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Nerve")
    expect(page.locator("[data-code='shot.crossed']")).to_contain_text("Right eye, Centre: could not take it.")
    assert look_for_faults(page, SHUTTER) == []
    tap(page, "[data-do=uncross]")
    expect(tile).to_have_attribute("data-face", "empty")
    expect(page.locator(SHUTTER)).to_contain_text("Right eye · Centre")
    tap(page, "#could-not")
    tap(page, "[data-reason=other]")
    tap(page, "[data-slot='R-centre']")
    taken(page)
    expect(tile).to_have_attribute("data-face", "good")
    assert stub.stub.visits.kept["v142"]["slots"]["R-centre"]["reason"] is None


def test_crossing_the_last_tile_by_keyboard_stays_there_and_offers_to_finish(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    for slot in SLOTS:
        expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("aria-current", "step")
        settled(page).locator("#could-not").focus()
        page.keyboard.press("Enter")
        page.locator("[data-reason=still]").focus()
        settled(page).keyboard.press("Enter")
        expect(page.locator(f"[data-slot='{slot}']")).to_have_attribute("data-face", "could_not")
    expect(page.locator("#could-not")).to_have_count(0)
    expect(page.locator("#finish.primary")).to_have_text("Finish")
    assert stub.stub.visits.kept["v142"]["finished_at"] is None
    tap(page, "#finish")
    expect(page.locator(".outcome .verdict")).to_contain_text("not possible")


def finished(open_page: Open, stub: Stubbed, size: tuple[int, int] = (1280, 800)) -> Page:
    """A visit with one picture, finished."""
    page = aiming(open_page, stub, size)
    taken(page)
    tap(page, "#finish")
    page.wait_for_selector("#done")
    return page


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_a_finished_visit_is_only_looked_at_until_it_is_opened_again(
    open_page: Open, stub: Stubbed, size: tuple[int, int]
) -> None:
    page = finished(open_page, stub, size)
    expect(page.locator("#reopen")).to_have_text("Open again")
    expect(page.locator("[data-slot='R-nerve']")).to_be_disabled()
    assert look_for_faults(page, "#done") == []
    tap(page, "[data-slot='R-centre']")
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.locator(".actions button")).to_have_count(1)
    expect(page.locator("#finish, #again, #next, #other-eye")).to_have_count(0)
    assert look_for_faults(page, "#result") == []
    settled(page).keyboard.press("r")
    expect(page.locator("#done")).to_be_visible()
    for there in ("aim/R-nerve", "person"):
        page.goto(f"{stub.url}/#/visit/v142/{there}")
        expect(page.locator("#done")).to_be_visible()
    assert stub.stub.presses == 1
    tap(page, "#reopen")
    live(page)
    assert stub.stub.visits.kept["v142"]["finished_at"] is None


def test_a_visit_of_an_earlier_day_cannot_be_opened_again(open_page: Open, stub: Stubbed) -> None:
    page = finished(open_page, stub)
    stub.stub.visits.kept["v142"]["undo_until"] = None
    page.reload()
    page.wait_for_selector("#done")
    expect(page.locator("#reopen")).to_have_count(0)
    page.goto(f"{stub.url}/#/visit/v142/film")
    page.wait_for_selector(".film li")
    expect(page.locator("#reopen")).to_have_count(0)


def test_what_went_wrong_stays_on_its_screen(open_page: Open, stub: Stubbed, complaints: Complaints) -> None:
    complaints.expect("409")
    page = finished(open_page, stub)
    words = {"code": "visit.finished", "message": "A0142 was finished on an earlier day.", "remedy": "Begin anew."}
    page.route("**/reopen", lambda route: route.fulfill(status=409, json=words))
    tap(page, "#reopen")
    expect(page.locator(".state-bar")).to_contain_text("A0142 was finished on an earlier day.")
    tap(page, "#done")
    page.wait_for_selector("#new")
    expect(page.locator(".state-bar")).to_have_count(0)


def test_a_limit_of_light_offers_no_other_eye_where_nobody_aims(open_page: Open, stub: Stubbed) -> None:
    stub.stub.problem = {"code": "light.limit", "message": "Enough for now.", "remedy": "Let it rest."}
    page = open_page(stub.url)
    expect(page.locator(".state-bar")).to_contain_text("Enough for now.")
    expect(page.locator("[data-do=otherEye]")).to_have_count(0)


def test_a_picture_of_the_other_eye_is_moved_by_hand_and_back(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    tap(page, "#open-details")
    expect(page.locator("#other-eye")).to_have_text("Change to the left eye")
    assert look_for_faults(page) == []
    tap(page, "#other-eye")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("data-face", "good")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "empty")
    expect(page.locator("[data-slot='L-centre']")).to_have_attribute("aria-current", "step")
    expect(page.locator("#details")).to_be_hidden()
    tap(page, "#open-details")
    tap(page, "#other-eye")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", "good")
    assert stub.stub.captures[0]["eye"] == "OD"


def test_four_pictures_as_fast_as_the_real_camera_allows(
    open_page: Open, server: Server, complaints: Complaints
) -> None:
    complaints.expect("409", "423")
    page = open_page(server.url)
    page.set_default_timeout(60_000)
    page.locator(".state[data-state=aim]").wait_for(state="attached", timeout=300_000)
    if settled(page).locator("[data-do=useHere]").count():
        page.locator("[data-do=useHere]").tap()
    new_person(page)
    for _ in range(12):  # a busy computer may cut a light: then the tile is asked for again, in words
        tap(page, f"{SHUTTER}[aria-disabled=false]")
        page.wait_for_selector("[data-phase=told], [data-phase=kept], .state-bar", timeout=60_000)
        if page.locator(".state-bar, [data-screen=aim]").count():
            continue
        if page.locator("[data-slot][data-face=empty]").count() == 0:
            break
        tap(page, "#next")
    tap(page, "#next[aria-disabled=false]")  # which says Finish when all four are there
    expect(page.locator(".outcome .verdict")).to_contain_text("The pictures are kept", timeout=60_000)
    expect(page.locator(".tiles [data-face=good]")).to_have_count(4)
