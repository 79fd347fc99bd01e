"""Alerts and languages: text, place, buttons and layout of every alert."""

import json
import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.alert_causes import CAUSES, StandingAlerts, alert, cut_power
from tests.browser.axe import axe_faults
from tests.browser.conftest import Complaints, MakeReal
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Instruments, Real
from tests.browser.walk import SHUTTER, Open, after_debounce, aiming, switch_language, tap, wait_for_preview
from tests.journey.conftest import until

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
SPECIFIED = set(
    re.findall(
        r"\S+",
        """
        camera.missing camera.stalled light.fault light.limit light.day cal.missing cal.mismatch cal.old
        light.cut shot.lost shot.crossed shot.next
        shot.saturated shot.dark shot.pupil shot.moved shot.blink shot.noeye shot.edge shot.halo shot.poor
        make.slow make.failed store.low store.full batt.low batt.empty heat.warm heat.hot power.lost link.lost
        link.slow link.other clock.unset clock.wrong send.waiting send.stuck eye.side consent.missing consent.declined
        """,
    )
)
ASSERTIVE = {"link.lost", "light.fault", "light.limit", "light.day", "heat.hot", "heat.warm"}
BLOCKING = {
    "camera.missing": "No camera",
    "light.fault": "Light fault",
    "light.day": "Light limit reached",
    "cal.missing": "Not calibrated",
    "cal.mismatch": "Not calibrated",
    "store.full": "No space",
    "batt.empty": "Battery empty",
    "heat.hot": r"Too hot – (5:00|4:\d\d)",
    "link.other": "Other tablet",
    "consent.missing": "Ask the patient first",
    "consent.declined": "Did not agree",
    "light.limit": r"Light limit: wait – \d+:\d\d",  # the last: its cause is hours old
}
ADVISORY = [
    "camera.stalled",
    "power.lost",
    "batt.low",
    "store.low",
    "clock.unset",
    "clock.wrong",
    "send.stuck",
    "make.slow",
    "heat.warm",
    "send.waiting",
    "cal.old",
]


def test_alert_table_matches_specification() -> None:
    table = (WEB / "core/alerts.js").read_text().split("const TABLE = [")[1].split("const SAME")[0]
    english = json.loads((WEB / "i18n/en.json").read_text())
    coded = set(
        re.findall(r'"((?:camera|light|cal|shot|make|store|batt|heat|power|link|clock|send|eye|consent)\.\w+)"', table)
    )
    assert coded == SPECIFIED
    states = {re.sub("_(one|other)$", "", key).removeprefix("state.") for key in english if key.startswith("state.")}
    assert states == SPECIFIED
    for words in [words for key, words in english.items() if key.startswith(("state.", "aim."))]:
        assert max(len(line.split()) for line in re.split(r"(?<=[.?…])\s", words)) <= 12
    forbidden = r"normal|healthy|disease|retinopathy|glaucoma|cataract|maculopathy"
    assert not re.findall(forbidden, " ".join(english.values()), re.IGNORECASE)


def test_blocking_alert_is_in_prompt_bar_and_shutter(
    open_page: Open, real: Real, standing_alerts: StandingAlerts, complaints: Complaints
) -> None:
    complaints.expect("409")
    page = aiming(open_page, real)

    def assert_blocked(code: str) -> None:
        bar = page.locator(f".prompt .state-bar[data-code='{code}']")
        expect(bar).to_be_visible()
        assert bar.locator("[role=alert]").count() == (1 if code in ASSERTIVE else 0)
        expect(page.locator(SHUTTER)).to_contain_text(re.compile(BLOCKING[code]))
        expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")

    for code in BLOCKING.keys() - StandingAlerts.CODES - {"light.limit"}:
        with alert(real, page, code):
            assert_blocked(code)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    page.locator(SHUTTER).focus()
    with alert(real, page, "heat.hot"):
        after_debounce(page).keyboard.press("Space")
    with alert(real, page, "light.limit"):
        assert_blocked("light.limit")
    assert real.presses == 0
    for code in ("cal.missing", "cal.mismatch"):
        standing_alerts.open(page, code)
        assert_blocked(code)


def test_one_blocking_alert_and_two_chips_by_priority(open_page: Open, make_real: MakeReal) -> None:
    real = make_real(weeks_old=30.0)
    page = aiming(open_page, real)
    chips = page.locator(".notices li")
    expect(page.locator("[data-code='cal.old']")).to_have_count(1)
    with alert(real, page, "heat.warm"), alert(real, page, "batt.empty"):
        expect(page.locator("[data-code='cal.old']")).to_have_count(1)
        with alert(real, page, "store.low"), alert(real, page, "light.fault"):
            expect(page.locator(".state-bar")).to_have_count(1)
            expect(page.locator(".state-bar")).to_contain_text("One light is not working.")
            assert [chip.get_attribute("data-code") for chip in chips.all()] == ["store.low", "heat.warm"]
        expect(page.locator(".state-bar")).to_contain_text("Battery is empty.")


def test_status_problem_is_shown_until_it_ends(open_page: Open, real: Real) -> None:
    faults = real.rig.world.faults
    faults.add("light.fault")
    real.wait_for_problem("light.fault")
    page = open_page(real.url)
    expect(page.get_by_role("alert")).to_contain_text("One light is not working.")
    faults.clear()
    real.wait_for_problem(None)
    expect(page.locator(".state-bar")).to_have_count(0)
    faults.add("camera.mode")
    unknown = real.wait_for_problem("input.frame")  # the page has no text of its own for this code
    expect(page.locator(".state-bar")).to_contain_text(f"{unknown['message'].capitalize()}. {unknown['remedy']}")


def test_self_check_finding_is_shown_once(open_page: Open, real: Real) -> None:
    visit = real.begin_visit(consent="agreed")["id"]
    with real.poor_light("diffuser"):
        for _ in range(2):
            real.press(visit)
            until(lambda: not real.rig.exam.calibration_monitor.has_pending)
    page = open_page(real.url)
    expect(page.locator(".notices li")).to_have_text(re.compile("has moved or aged"))
    page.locator("[data-do=later]").tap()
    expect(page.locator(".notices")).to_have_count(0)


def test_light_limit_offers_other_eye(open_page: Open, real: Real) -> None:
    visit = real.begin_visit(consent="agreed")["id"]
    CAUSES["light.limit"](real, visit)
    page = after_debounce(open_page(f"{real.url}/#/visit/{visit}/aim/R-centre"))
    expect(page.locator(".state-bar")).to_contain_text(re.compile(r"Wait \d+ minutes with this eye\."))
    expect(page.locator(SHUTTER)).to_contain_text(re.compile(r"Light limit: wait – \d+:\d\d"))
    page.locator("[data-do=otherEye]").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Take picture")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")


def test_poor_verdict_shows_cause_and_action(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    english = json.loads((WEB / "i18n/en.json").read_text())
    for cause in ("halo", "saturated", "pupil"):  # the other causes use the same code; their texts are checked above
        visit = real.begin_visit(consent="agreed")["id"]
        page.goto(f"{real.url}/#/visit/{visit}/aim/R-centre")
        wait_for_preview(page)
        real.show(cause)
        tap(page, SHUTTER)
        expect(page.locator(".card")).to_contain_text(english[f"state.shot.{cause}"])
        assert (page.locator("[data-do=timer]").count() == 1) == (cause == "pupil")
        page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
        expect(page.locator(".prompt")).to_have_text("Right eye · Macula Final picture, but not good enough")
        expect(page.locator(".prompt")).to_have_attribute("data-tone", "plain")  # no green tick over "Take again"
    page.locator("[data-do=timer]").tap()
    expect(page.locator(".card .clock")).to_have_text(re.compile(r"1:00|0:5\d"))


def test_failed_reconstruction_is_reported_and_frame_kept(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    real.event_bus.on_press = lambda: real.rig.world.faults.add("camera.mode")
    page.locator(SHUTTER).tap()
    expect(page.locator(".card")).to_contain_text("The picture could not be processed. Its raw frames are saved.")
    expect(page.locator("#keep")).to_be_visible()


def test_power_loss_alert_names_slot_and_links_to_it(open_page: Open, standing_alerts: StandingAlerts) -> None:
    page = open_page(standing_alerts.instrument("power.lost").url)
    notice = page.locator("[data-code='power.lost']")
    expect(notice).to_contain_text("Power went off during a picture. Left eye, Optic disc: please take again.")
    notice.get_by_role("button", name="Take it now").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Left eye · Optic disc")


def test_power_loss_alert_without_visits(
    open_page: Open, instruments: Instruments, make_real: MakeReal, undo: ExitStack
) -> None:
    real = cut_power(instruments, cut_power(instruments, make_real()))
    undo.callback(real.close)
    page = open_page(real.url)
    expect(page.locator("[data-code='power.lost']")).to_contain_text("Power went off during 2 pictures.")
    page.get_by_role("button", name="OK").tap()
    expect(page.locator(".notices")).to_have_count(0)


LONGEST = {"phone": "ta", "small": "en-XA", "portrait": "te", "tablet": "hi"}  # language with long texts, by size


def look_everywhere(page: Page, *in_view: str) -> list[str]:
    """Return the violations of `look_for_faults` in the sizes and languages of LONGEST, and those of axe-core."""
    faults = []
    for size, language in LONGEST.items():
        width, height = SIZES[size]
        page.set_viewport_size({"width": width, "height": height})
        switch_language(page, language)
        faults += [f"{size} {language}: {fault}" for fault in look_for_faults(page, *in_view)]
    faults += [f"axe: {fault}" for fault in axe_faults(page)]
    page.locator("[data-link=live]").wait_for()  # axe blocks the page long enough to miss heartbeats
    return faults


def test_every_alert_fits_in_longest_texts_without_axe_violation(
    open_page: Open, real: Real, standing_alerts: StandingAlerts, complaints: Complaints
) -> None:
    complaints.expect("409")
    page = open_page("about:blank")
    visit = real.begin_visit(consent="agreed", sex="woman", age=54)
    faults: dict[str, list[str]] = {}
    for code in StandingAlerts.CODES:
        standing_alerts.open(page, code)
        faults[code] = look_everywhere(page, SHUTTER)
    page.goto(f"{real.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector("eye-live[data-frame]")
    for code in CAUSES:
        with alert(real, page, code):
            faults[code] = look_everywhere(page, SHUTTER)
    assert faults.keys() == {*BLOCKING, *ADVISORY}
    real.show("saturated")
    real.hold = "stored"
    page.locator(SHUTTER).tap()
    page.wait_for_selector("[data-phase=assessed]")
    faults["assessed"] = look_everywhere(page, "#again")
    real.hold = None
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    faults["again"] = look_everywhere(page, "#again", "#keep")
    for place in ("patient", "pictures", "outcome"):
        page.goto(f"{real.url}/#/visit/{visit['id']}/{place}")
        page.wait_for_selector(f".{place}")
        faults[place] = look_everywhere(page)
    assert {name: found for name, found in faults.items() if found} == {}


def test_language_is_loaded_and_stored(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    page.get_by_role("button", name="தமிழ்").tap()
    expect(page.locator("#new")).to_have_text(re.compile("புதிய நோயாளி"))
    expect(page.locator("html")).to_have_attribute("lang", "ta")
    expect(page.locator(".languages")).to_contain_text("சரிபார்க்கப்படவில்லை")
    page.reload()
    expect(page.locator("#new")).to_have_text(re.compile("புதிய நோயாளி"))
    page.get_by_role("button", name="English").tap()
    expect(page.locator("#new")).to_have_text(re.compile("New patient"))
