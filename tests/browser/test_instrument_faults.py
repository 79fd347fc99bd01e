"""Faults of a small simulated head on the real server, as the exam page shows them."""

import re
from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from device.values import BatteryState
from tests.browser.alert_causes import clock_folder
from tests.browser.conftest import Complaints
from tests.browser.real import Real
from tests.browser.walk import SHUTTER, Open, after_debounce, agree, take_picture, tap, visit_of, wait_for_preview
from tests.journey.asking import MAX_BYTES
from tests.journey.faults import wait_until_idle

pytestmark = pytest.mark.browser


def aiming(open_page: Open, real: Real, slot: str = "R-centre") -> Page:
    """Open a page that aims at the first slot of a new patient with consent."""
    page = open_page(real.url)
    tap(page, "#new")
    agree(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    return page


def expect_blocking(page: Page, code: str, words: str, on_the_button: str) -> None:
    expect(page.locator(f".state-bar[data-code='{code}']")).to_contain_text(words)
    expect(page.locator(SHUTTER)).to_contain_text(re.compile(on_the_button))
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")


def expect_chip(page: Page, code: str, words: str) -> None:
    expect(page.locator(f".notices [data-code='{code}']")).to_contain_text(re.compile(words))


def expect_ended(page: Page, code: str) -> None:
    expect(page.locator(f"[data-code='{code}']")).to_have_count(0)


def test_temperature_and_battery_alerts_begin_and_end(open_page: Open, real: Real) -> None:
    page, world = aiming(open_page, real), real.rig.world
    world.temperature_c = 52.0
    expect_chip(page, "heat.warm", "Pictures take a little longer")
    world.temperature_c = 61.0
    expect_blocking(page, "heat.hot", "Put it in the shade for 5 minutes.", r"Too hot – (5:00|4:\d\d)")
    expect_ended(page, "heat.warm")
    world.temperature_c = 25.0
    expect_ended(page, "heat.hot")
    world.battery_state = BatteryState(0.12, 3.6)
    expect_chip(page, "batt.low", "Battery for about 4 more patients")
    world.battery_state = BatteryState(0.02, 3.3)
    expect_blocking(page, "batt.empty", "Plug in now. Work is saved.", "Battery empty")
    world.battery_state = BatteryState(0.9, 4.0)
    expect_ended(page, "batt.empty")
    take_picture(page)


def test_hardware_fault_alerts_begin_and_end(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("503", "423")
    page, faults = aiming(open_page, real), real.rig.world.faults
    faults.add("camera.missing")
    expect_blocking(page, "camera.missing", "Turn the device off and on.", "No camera")
    faults.clear()
    expect_ended(page, "camera.missing")
    faults.add("light.fault")
    expect_blocking(page, "light.fault", "One light is not working.", "Light fault")
    faults.clear()
    expect_ended(page, "light.fault")
    faults.add("camera.stalled")
    expect_chip(page, "camera.stalled", "It will come back")
    faults.clear()
    expect_ended(page, "camera.stalled")
    real.event_bus.on_press = lambda: faults.add("camera.mode")
    take_picture(page)
    expect(page.locator(".card")).to_contain_text("The picture could not be processed. Its raw frames are saved.")
    faults.clear()
    tap(page, "#again")
    take_picture(page)


def test_full_storage_during_visit_keeps_captures(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    kept = real.rig.store.captures()
    tap(page, "#next")
    wait_for_preview(page)
    real.free_space.free_bytes = 0
    expect_blocking(page, "store.full", "Nothing was lost. Copy to USB or send.", "No space")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", re.compile("good|poor"))
    after_debounce(page).locator(SHUTTER).tap(force=True)
    assert real.rig.store.captures() == kept
    real.free_space.free_bytes = (
        sum(path.stat().st_size for path in (real.rig.store.folder / "captures" / kept[0].id).iterdir()) * 30
    )
    expect_ended(page, "store.full")
    expect_chip(page, "store.low", r"Space for \d+ more")
    real.free_space.free_bytes = MAX_BYTES
    expect_ended(page, "store.low")
    take_picture(page)
    assert len(real.rig.store.captures()) == len(kept) + 1


def test_the_time_of_the_tablet_is_left_for_the_device_when_its_user_accepts_it(open_page: Open, real: Real) -> None:
    """A device without network and clock cell, whose date is a month old."""
    page, folder = aiming(open_page, real), clock_folder(real)
    real.clock.moved = timedelta(days=-30)
    folder.mkdir(parents=True)
    expect_chip(page, "clock.unset", rf"The device does not know the date\. Is it .*{datetime.now(UTC).year}, ")
    assert list(folder.iterdir()) == []
    page.locator("[data-code='clock.unset'] [data-do=timeIsRight]").tap()
    expect_ended(page, "clock.unset")
    accepted = datetime.fromisoformat((folder / "request").read_text())
    assert abs(datetime.now(UTC) - accepted) < timedelta(minutes=2)


@pytest.mark.parametrize("to", [datetime(2020, 1, 2, 12, tzinfo=UTC), datetime.now(UTC) + timedelta(days=300)])
def test_clock_jump_keeps_order_and_dose(open_page: Open, real: Real, to: datetime) -> None:
    page, ledger = aiming(open_page, real), real.rig.exam.head.light.ledger
    take_picture(page)
    first, spent = real.rig.store.captures(1)[0], ledger.spent_j_per_cm2("OD")
    tap(page, "#again")
    wait_for_preview(page)
    real.clock.moved = to - datetime.now(UTC)
    expect_chip(page, "clock.wrong", rf"The date looks wrong\. Is today .*{to.year}\?")
    page.locator("[data-code='clock.wrong'] [data-do=dateIsRight]").tap()
    expect_ended(page, "clock.wrong")
    take_picture(page)
    second = real.rig.store.captures(1)[0]
    assert second.taken_at.date() == to.date() != first.taken_at.date()
    assert [capture.id for capture in real.rig.store.captures(2)] == [second.id, first.id]
    slot = page.evaluate(f"fetch('/api/visits/{visit_of(page)}').then((answer) => answer.json())")["slots"]["R-centre"]
    assert slot["captures"] == [first.id, second.id]
    assert ledger.spent_j_per_cm2("OD") > spent, "no date forgives a dose"
    expect(page.locator(".state-bar")).to_have_count(0)  # the lease uses monotonic time


def test_daily_light_limit_is_per_eye(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("423")
    page, light = aiming(open_page, real), real.rig.exam.head.light
    stop = light.hazard.limits.stop_j_per_cm2
    given = light.ledger.reserve(("OD",), 0.999 * (stop - light.ledger.spent_j_per_cm2("OD")), stop)
    tap(page, SHUTTER)
    expect_blocking(
        page, "light.day", "Today’s light limit is reached. No more pictures of this eye.", "Light limit reached"
    )
    tap(page, "[data-slot='L-centre']")
    wait_for_preview(page)
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    take_picture(page)
    light.ledger.settle(given, 0.0)


def test_a_page_that_only_shows_pictures_leaves_the_camera(open_page: Open, real: Real) -> None:
    visit = real.begin_visit(consent="agreed")["id"]
    capture = real.press(visit)["id"]
    reader = open_page(f"{real.url}/#/visit/{visit}/picture/R-centre/{capture}")
    reader.wait_for_selector(".stage[data-mark=final]")
    expect(reader.locator(".state")).to_have_text("Ready")
    reader.wait_for_timeout(2500)  # two heartbeats
    assert real.request("GET", "/api/status")["controller"] is None
    aiming(open_page, real)
    expect(reader.locator(".prompt .title")).to_have_text("Right eye · Macula")
    reader.wait_for_timeout(2500)  # the monitor publishes the holder once per second
    expect(reader.locator(".state-bar")).to_have_count(0)


def test_control_is_released_when_page_closes(open_page: Open, real: Real) -> None:
    first = aiming(open_page, real)
    second = open_page(f"{real.url}/#/visit/{visit_of(first)}/aim/R-centre")
    expect(second.locator(".state-bar[data-code='link.other']")).to_be_visible()
    first.goto("about:blank")
    expect(second.locator(".state-bar")).to_have_count(0)
    take_picture(second)


def test_double_tap_makes_one_picture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    before = len(real.rig.store.captures())
    after_debounce(page).locator(SHUTTER).dblclick()
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    assert len(real.rig.store.captures()) == before + 1


HOSTILE = ["<img src=x onerror=alert(1)>", "'; DROP TABLE patients; --", "{{7*7}}", "\u202egnp.exe", "x" * 100]


def test_markup_in_form_fields_is_stored_as_text(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("422")
    page = aiming(open_page, real)
    page.on("dialog", lambda dialog: pytest.fail(f"form input was executed: {dialog.message}"))
    change = """async ([visit, field, value, key]) => {
        const headers = { "Content-Type": "application/json" };
        const body = JSON.stringify({ key, field, value });
        return (await fetch(`/api/visits/${visit}`, { method: "PATCH", headers, body })).status;
    }"""
    visit, statuses = visit_of(page), set()
    for number, field in enumerate(("name", "phone", "village", "complaints", "age", "sex", "consent", "vision_od")):
        for other, words in enumerate(HOSTILE):
            statuses.add(page.evaluate(change, [visit, field, words, f"{16 * number + other:016x}"]))
    assert statuses <= {200, 422}
    fields = page.evaluate(f"fetch('/api/visits/{visit}').then((answer) => answer.json())")["fields"]
    assert fields["name"] in HOSTILE
    assert fields["consent"] == "agreed"
    for screen in (f"visit/{visit}/patient", f"visit/{visit}/pictures", "find", "history"):
        page.goto(f"{real.url}/#/{screen}")
        page.wait_for_selector(f"[data-screen={screen.split('/')[-1]}]")
        assert page.locator("img[src=x]").count() == 0
    page.goto(f"{real.url}/#/find")
    page.wait_for_selector("[data-screen=find]")


def test_cross_origin_page_cannot_switch_on_lamp(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("403", "/api/preview")
    wait_until_idle(real.rig)  # the page of the previous test is closed
    frames = real.rig.world.frames
    page = open_page("about:blank")
    page.set_content(f'<img src="{real.url}/api/preview?after=0">')
    assert page.evaluate("document.images[0].decode().then(() => 1, () => 0)") == 0
    page.evaluate(f"fetch('{real.url}/api/preview', {{ mode: 'no-cors' }}).catch(() => 0)")
    with_key = f"fetch('{real.url}/api/preview', {{ headers: {{ 'X-Controller': 'a' }} }}).then(() => 1, () => 0)"
    assert page.evaluate(with_key) == 0
    assert real.rig.world.frames == frames
