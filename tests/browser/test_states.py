"""Every state that can stop or only tell: its words, its one place, its buttons, in the languages that stretch most."""

import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import Complaints
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import SHUTTER, Open, aiming, settled, spoken, tap

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
SPECIFIED = set(
    re.findall(
        r"\S+",
        """
        camera.missing camera.stalled light.fault light.limit light.day cal.missing cal.mismatch cal.old
        light.cut shot.lost shot.crossed
        shot.saturated shot.dark shot.pupil shot.moved shot.blink shot.noeye shot.edge shot.halo shot.poor
        make.slow make.failed store.low store.full batt.low batt.empty heat.warm heat.hot power.lost link.lost
        link.slow link.other clock.wrong send.waiting send.stuck lock.idle eye.side consent.missing consent.declined
        """,
    )
)
NUMBERS = {"n": 3, "date": "3 May 2026", "eye": "OS", "slot": "L-nerve", "visit": "v142", "other": "OS"}
ALOUD = {"link.lost", "light.fault", "light.limit", "light.day", "heat.hot", "heat.warm"}
STOPS = {
    "camera.missing": "No camera",
    "light.fault": "Light fault",
    "light.limit": "Rest this eye – 3:00",
    "light.day": "No more light",
    "cal.missing": "Needs set-up",
    "cal.mismatch": "Needs set-up",
    "store.full": "No space",
    "batt.empty": "Battery empty",
    "heat.hot": "Too hot – 5:00",
    "link.other": "Other screen",
    "lock.idle": "Locked",
    "consent.missing": "First ask: may we?",
    "consent.declined": "Did not agree",
}
TELLS = ["camera.stalled", "power.lost", "batt.low", "store.low", "clock.wrong", "send.stuck", "make.slow", "heat.warm",
         "send.waiting", "cal.old"]  # fmt: skip
CAUSES = ["saturated", "dark", "pupil", "moved", "blink", "noeye", "edge", "halo"]


def tell(stub: Stubbed, page: Page, code: str, **more: Any) -> None:
    if code == "link.other":
        stub.stub.controller = "another screen"
        stub.stub.events.append(("notice", {"code": code}))
    else:
        stub.stub.tell("notice", {"code": code, **NUMBERS, **more})
    page.locator(f"[data-code='{code}']").wait_for()


def over(stub: Stubbed, page: Page, code: str) -> None:
    if code == "link.other":
        stub.stub.controller = None
    stub.stub.tell("notice", {"code": code, "over": True})
    expect(page.locator(f"[data-code='{code}']")).to_have_count(0)


def test_the_table_holds_every_state_of_the_specification_with_words_and_nothing_else() -> None:
    table = (WEB / "states.js").read_text().split("const TABLE = [")[1].split("const SAME")[0]
    english = (WEB / "english.js").read_text()
    coded = set(
        re.findall(
            r'"((?:camera|light|cal|shot|make|store|batt|heat|power|link|clock|send|lock|eye|consent)\.\w+)"', table
        )
    )
    assert coded == SPECIFIED
    assert set(re.findall(r'"state\.([\w.]+)":', english)) == SPECIFIED
    for words in re.findall(r'"(?:state|aim)\.[\w.]+": "(.+)"', english):
        assert max(len(line.split()) for line in re.split(r"(?<=[.?…])\s", words)) <= 12
    forbidden = r"normal|healthy|disease|retinopathy|glaucoma|cataract|macula"
    assert not re.findall(forbidden, re.sub(r"//.*", "", english), re.IGNORECASE)


def test_what_stops_is_in_the_prompt_bar_and_its_reason_in_the_shutter(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    for code, reason in STOPS.items():
        tell(stub, page, code)
        bar = page.locator(f".prompt .state-bar[data-code='{code}']")
        expect(bar).to_be_visible()
        assert bar.locator("[role=alert]").count() == (1 if code in ALOUD else 0)
        expect(page.locator(SHUTTER)).to_contain_text(
            re.compile(re.escape(reason).replace("3:00", r"(3:00|2:5\d)").replace("5:00", r"(5:00|4:5\d)"))
        )
        expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")
        over(stub, page, code)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    page.locator(SHUTTER).focus()
    tell(stub, page, "heat.hot")
    settled(page).keyboard.press("Space")
    assert stub.stub.presses == 0


def test_one_stop_and_two_chips_at_most_and_the_worst_first(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    for code in ("cal.old", "heat.warm", "cal.missing"):
        tell(stub, page, code)
    for code in ("batt.low", "light.fault", "camera.stalled"):
        tell(stub, page, code)
    expect(page.locator(".state-bar")).to_have_count(1)
    expect(page.locator(".state-bar")).to_contain_text("One light is not working.")
    chips = page.locator(".notices li")
    assert [chip.get_attribute("data-code") for chip in chips.all()] == ["camera.stalled", "batt.low"]
    over(stub, page, "light.fault")
    expect(page.locator(".state-bar")).to_contain_text("needs setting up before")


def test_the_problem_of_the_status_stands_on_every_screen_and_goes_by_itself(open_page: Open, stub: Stubbed) -> None:
    stub.stub.problem = {"code": "head.hot", "message": "It is 71 degrees.", "remedy": "Turn it off."}
    page = open_page(stub.url)
    expect(page.get_by_role("alert")).to_have_text("Too hot. Put it in the shade for 5 minutes.")
    stub.stub.problem = {"code": "bus.fault", "message": "No answer on the bus.", "remedy": "Turn it off and on."}
    expect(page.get_by_role("status")).to_contain_text("No answer on the bus. Turn it off and on.")
    stub.stub.problem = None
    expect(page.locator(".state-bar")).to_have_count(0)


def test_what_the_instrument_found_is_told_once_in_its_own_words(open_page: Open, stub: Stubbed) -> None:
    stub.stub.notices = ["The camera is warmer than at its calibration. Pictures are still fine."]
    page = open_page(stub.url)
    expect(page.locator(".notices li")).to_have_text(re.compile("warmer than at its calibration"))
    page.locator("[data-do=later]").tap()
    expect(page.locator(".notices")).to_have_count(0)


def test_too_much_light_for_one_eye_offers_the_other(open_page: Open, stub: Stubbed, complaints: Complaints) -> None:
    complaints.expect("423")
    stub.stub.refuse = (423, {"code": "light.limit", "message": "Enough.", "remedy": "Rest.", "n": 4})
    page = aiming(open_page, stub)
    tap(page, SHUTTER)
    expect(page.locator(".state-bar")).to_contain_text("Rest it 4 minutes.")
    expect(page.locator(SHUTTER)).to_contain_text(re.compile(r"Rest this eye – (4:00|3:5\d)"))
    stub.stub.refuse = None
    page.locator("[data-do=otherEye]").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Take picture")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")


def test_a_cause_is_told_with_one_thing_to_do(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin()
    page = aiming(open_page, stub)
    stub.stub.refine_s = stub.stub.expose_s = 0.05
    english = (WEB / "english.js").read_text()
    for cause in ("pupil", "moved", "halo"):  # the others go the same way; their words are checked above
        stub.stub.verdicts = [f"shot.{cause}"]
        stub.stub.visits.kept["v143"]["slots"]["R-centre"]["tries"] = 0
        tap(page, SHUTTER)
        words = re.search(rf'"state\.shot\.{cause}": "(.+)"', english)
        assert words is not None
        expect(page.locator(".card")).to_contain_text(words[1])
        assert (page.locator("[data-do=timer]").count() == 1) == (cause == "pupil")
        tap(page, "#again")
    stub.stub.verdicts = ["shot.pupil"]
    tap(page, SHUTTER)
    page.locator("[data-do=timer]").tap()
    expect(page.locator(".card .clock")).to_have_text(re.compile(r"1:00|0:5\d"))


def test_a_picture_that_could_not_be_made_says_so_and_the_shot_is_kept(open_page: Open, stub: Stubbed) -> None:
    stub.stub.verdicts = ["make.failed"]
    page = aiming(open_page, stub)
    page.locator(SHUTTER).tap()
    expect(page.locator(".card")).to_contain_text("The picture could not be made. The shot is kept.")
    expect(page.locator("#keep")).to_be_visible()


def test_power_that_went_off_names_the_eye_and_goes_there(open_page: Open, stub: Stubbed) -> None:
    stub.stub.visits.begin(consent="agreed")
    stub.stub.swept = [{"id": "a", "visit": "v142", "slot": "L-nerve", "eye": "OS"}]
    page = open_page(stub.url)
    notice = page.locator("[data-code='power.lost']")
    expect(notice).to_contain_text("Power went off during a picture. Left eye, Nerve: please take again.")
    notice.get_by_role("button", name="Take it now").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Nerve")


def test_old_sweepings_are_told_without_names(open_page: Open, stub: Stubbed) -> None:
    stub.stub.swept = [{"id": name, "eye": None, "visit": None, "slot": None, "tries": 0} for name in "ab"]
    page = open_page(stub.url)
    expect(page.locator("[data-code='power.lost']")).to_contain_text("Power went off during 2 pictures.")
    page.get_by_role("button", name="OK").tap()
    expect(page.locator(".notices")).to_have_count(0)


@pytest.mark.parametrize(
    ("size", "language"), [("phone", "ta"), ("small", "en-XA"), ("portrait", "te"), ("tablet", "hi")]
)
def test_every_state_fits_in_the_longest_words(open_page: Open, stub: Stubbed, size: str, language: str) -> None:
    page = open_page("about:blank", SIZES[size])
    spoken(page, language)
    visit = stub.stub.visits.begin(consent="agreed", sex="woman", age=54)
    page.goto(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector("eye-live[data-frame]")
    faults: dict[str, list[str]] = {}
    for code in [*STOPS, *TELLS]:
        tell(stub, page, code)
        faults[code] = look_for_faults(page, SHUTTER)
        over(stub, page, code)
    stub.stub.verdicts = ["shot.dark"]
    stub.stub.hold = "keep"
    page.locator(SHUTTER).tap()
    page.wait_for_selector("[data-phase=told]")
    faults["told"] = look_for_faults(page, "#again")
    stub.stub.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    faults["again"] = look_for_faults(page, "#again", "#keep")
    for place in ("person", "film", "outcome"):
        page.goto(f"{stub.url}/#/visit/{visit['id']}/{place}")
        page.wait_for_selector(f".{place}")
        faults[place] = look_for_faults(page)
    assert {name: found for name, found in faults.items() if found} == {}


def test_a_language_is_loaded_when_it_is_chosen_and_remembered(open_page: Open, stub: Stubbed) -> None:
    page = open_page(stub.url)
    page.get_by_role("button", name="தமிழ்").tap()
    expect(page.locator("#new")).to_have_text(re.compile("புதிய நபர்"))
    expect(page.locator("html")).to_have_attribute("lang", "ta")
    expect(page.locator(".languages")).to_contain_text("வரைவு")
    page.reload()
    expect(page.locator("#new")).to_have_text(re.compile("புதிய நபர்"))
    page.get_by_role("button", name="English").tap()
    expect(page.locator("#new")).to_have_text(re.compile("New person"))


@pytest.mark.parametrize("language", ["hi", "ta", "te"])
def test_a_translation_knows_only_keys_and_numbers_of_the_master(language: str) -> None:
    def table(name: str) -> dict[str, set[str]]:
        rows = re.findall(r'^  "([^"]+)": (.+(?:\n    .+)*)', (WEB / name).read_text(), re.M)
        return {key: set(re.findall(r"\{(\w+)\}", words)) - {"n"} for key, words in rows}

    master, draft = table("english.js") | table("english_send.js"), table(f"words_{language}.js")
    assert set(draft) <= set(master)
    assert {key: names for key, names in draft.items() if names != master[key]} == {}
    missing = {key for key in master if key.startswith(("state.", "stop.", "do.", "aim.", "verdict."))} - set(draft)
    assert missing <= {"do.pin", "aim.live", "stop.other"}
