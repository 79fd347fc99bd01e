"""Faults of the real instrument as a health worker sees them: a small simulated head, broken while it serves."""

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from device.values import Charge
from tests.browser.conftest import Complaints, free_port
from tests.browser.real import Real
from tests.browser.walk import SHUTTER, Open, live, settled, tap
from tests.journey.asking import MOST_BYTES
from tests.journey.faults import rest

pytestmark = pytest.mark.browser

SOON_MS = 15_000  # a second for the instrument to look, and a busy computer


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Real]:
    with Real(tmp_path_factory.mktemp("real"), free_port()) as real:
        yield real


@pytest.fixture
def real(instrument: Real) -> Iterator[Real]:
    instrument.rig.app.state.notices.lease._until_s = 0.0  # the tablet of the test before is gone, without a word
    yield instrument
    rig, world = instrument.rig, instrument.rig.world
    world.faults.clear()
    world.celsius, world.charge = 25.0, Charge(0.775, 3.88)
    instrument.shelf.free_bytes, instrument.clock.moved = MOST_BYTES, timedelta(0)
    for heap in (rig.exam.fitness._sights, rig.exam.fitness._spheres_dpt):
        heap.clear()


def aiming(open_page: Open, real: Real, slot: str = "R-centre") -> Page:
    """A tablet that aims at the first picture of somebody new who agreed."""
    page = open_page(real.url)
    tap(page, "#new")
    tap(page, "[data-value=agreed]")
    tap(page, "#shoot")
    live(page)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false", timeout=SOON_MS)
    return page


def visit_of(page: Page) -> str:
    found = re.search(r"visit/([^/]+)/", page.url)
    assert found is not None
    return found[1]


def taken(page: Page) -> None:
    tap(page, SHUTTER)
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")


def stops(page: Page, code: str, words: str, on_the_button: str) -> None:
    expect(page.locator(f".state-bar[data-code='{code}']")).to_contain_text(words, timeout=SOON_MS)
    expect(page.locator(SHUTTER)).to_contain_text(re.compile(on_the_button))
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "true")


def tells(page: Page, code: str, words: str) -> None:
    expect(page.locator(f".notices [data-code='{code}']")).to_contain_text(re.compile(words), timeout=SOON_MS)


def is_over(page: Page, code: str) -> None:
    expect(page.locator(f"[data-code='{code}']")).to_have_count(0, timeout=SOON_MS)


def test_heat_and_battery_say_so_in_time_and_go_by_themselves(open_page: Open, real: Real) -> None:
    page, world = aiming(open_page, real), real.rig.world
    world.celsius = 52.0
    tells(page, "heat.warm", "Pictures take a little longer")
    world.celsius = 61.0
    stops(page, "heat.hot", "Put it in the shade for 5 minutes.", r"Too hot – (5:00|4:\d\d)")
    is_over(page, "heat.warm")
    world.celsius = 25.0
    is_over(page, "heat.hot")
    world.charge = Charge(0.12, 3.6)
    tells(page, "batt.low", "Battery for about 4 more people")
    world.charge = Charge(0.02, 3.3)
    stops(page, "batt.empty", "Plug in now. Work is saved.", "Battery empty")
    world.charge = Charge(0.9, 4.0)
    is_over(page, "batt.empty")
    taken(page)


def test_broken_parts_are_named_and_mended_ones_forgotten(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("503", "423")
    page, faults = aiming(open_page, real), real.rig.world.faults
    faults.add("camera.missing")
    stops(page, "camera.missing", "Turn the device off and on.", "No camera")
    faults.clear()
    is_over(page, "camera.missing")
    faults.add("light.fault")
    stops(page, "light.fault", "One light is not working.", "Light fault")
    faults.clear()
    is_over(page, "light.fault")
    faults.add("camera.stalled")
    tells(page, "camera.stalled", "It will come back")
    faults.clear()
    is_over(page, "camera.stalled")
    real.bulletin.at_the_press = lambda: faults.add("camera.mode")
    taken(page)
    expect(page.locator(".card")).to_contain_text("The picture could not be made. The shot is kept.")
    faults.clear()
    tap(page, "#again")
    taken(page)


def test_a_full_shelf_in_the_middle_of_a_visit_loses_nothing_and_goes_on(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    taken(page)
    kept = real.rig.store.captures()
    tap(page, "#next")
    live(page)
    real.shelf.free_bytes = 0
    stops(page, "store.full", "Nothing was lost. Copy to USB or send.", "No space")
    expect(page.locator("[data-slot='R-centre']")).to_have_attribute("data-face", re.compile("good|poor"))
    settled(page).locator(SHUTTER).tap(force=True)
    assert real.rig.store.captures() == kept
    real.shelf.free_bytes = sum(
        path.stat().st_size for path in (real.rig.store.folder / "captures" / kept[0].id).iterdir()
    ) * 30  # fmt: skip
    is_over(page, "store.full")
    tells(page, "store.low", r"Space for \d+ more")
    real.shelf.free_bytes = MOST_BYTES
    is_over(page, "store.low")
    taken(page)
    assert len(real.rig.store.captures()) == len(kept) + 1


@pytest.mark.parametrize("to", [datetime(2020, 1, 2, 12, tzinfo=UTC), datetime.now(UTC) + timedelta(days=300)])
def test_a_date_that_jumps_is_asked_about_and_changes_neither_order_nor_dose(
    open_page: Open, real: Real, to: datetime
) -> None:
    page, ledger = aiming(open_page, real), real.rig.exam.head.light.ledger
    taken(page)
    first, spent = real.rig.store.captures(1)[0], ledger.spent_j_per_cm2("OD")
    tap(page, "#again")
    live(page)
    real.clock.moved = to - datetime.now(UTC)
    tells(page, "clock.wrong", rf"The date looks wrong\. Is today .*{to.year}\?")
    page.locator("[data-code='clock.wrong'] [data-do=dateIsRight]").tap()
    is_over(page, "clock.wrong")
    taken(page)
    second = real.rig.store.captures(1)[0]
    assert second.taken_at.date() == to.date() != first.taken_at.date()
    assert [one.id for one in real.rig.store.captures(2)] == [second.id, first.id]
    slot = page.evaluate(f"fetch('/api/visits/{visit_of(page)}').then((answer) => answer.json())")["slots"]["R-centre"]
    assert slot["captures"] == [first.id, second.id]
    assert ledger.spent_j_per_cm2("OD") > spent, "no date forgives a dose"
    expect(page.locator(".state-bar")).to_have_count(0)  # the lease, too, goes by time that passes


def test_an_eye_that_had_its_light_is_spared_and_the_other_goes_on(
    open_page: Open, real: Real, complaints: Complaints
) -> None:
    complaints.expect("423")
    page, light = aiming(open_page, real), real.rig.exam.head.light
    stop = light.hazard.limits.stop_j_per_cm2
    given = light.ledger.reserve(("OD",), 0.999 * (stop - light.ledger.spent_j_per_cm2("OD")), stop)
    tap(page, SHUTTER)
    stops(page, "light.day", "This eye has had today's full light. Do not take more.", "No more light")
    tap(page, "[data-slot='L-centre']")
    live(page)
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    taken(page)
    light.ledger.settle(given, 0.0)


def test_a_second_tablet_can_go_on_as_soon_as_the_first_page_closes(open_page: Open, real: Real) -> None:
    first = aiming(open_page, real)
    second = open_page(f"{real.url}/#/visit/{visit_of(first)}/aim/R-centre")
    expect(second.locator(".state-bar[data-code='link.other']")).to_be_visible(timeout=SOON_MS)
    first.goto("about:blank")
    expect(second.locator(".state-bar")).to_have_count(0, timeout=8_000)
    taken(second)


def test_two_taps_and_two_tablets_make_one_picture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    before = len(real.rig.store.captures())
    settled(page).locator(SHUTTER).dblclick()
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    assert len(real.rig.store.captures()) == before + 1


HOSTILE = ["<img src=x onerror=alert(1)>", "'; DROP TABLE persons; --", "{{7*7}}", "\u202egnp.exe", "x" * 100]


def test_hostile_words_in_every_field_are_kept_as_words(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("422")
    page = aiming(open_page, real)
    page.on("dialog", lambda dialog: pytest.fail(f"somebody's words were run: {dialog.message}"))
    change = """async ([visit, field, value, key]) => {
        const headers = { "Content-Type": "application/json" };
        const body = JSON.stringify({ key, field, value });
        return (await fetch(`/api/visits/${visit}`, { method: "PATCH", headers, body })).status;
    }"""
    visit, told = visit_of(page), set()
    for number, field in enumerate(("name", "phone", "village", "complaints", "age", "sex", "consent", "vision_od")):
        for other, words in enumerate(HOSTILE):
            told.add(page.evaluate(change, [visit, field, words, f"{16 * number + other:016x}"]))
    assert told <= {200, 422}
    fields = page.evaluate(f"fetch('/api/visits/{visit}').then((answer) => answer.json())")["fields"]
    assert fields["name"] in HOSTILE
    assert fields["consent"] == "agreed"
    for screen in (f"visit/{visit}/person", f"visit/{visit}/film", "find", "history"):
        page.goto(f"{real.url}/#/{screen}")
        page.wait_for_selector(f"[data-screen={screen.split('/')[-1]}]")
        assert page.locator("img[src=x]").count() == 0
    page.goto(f"{real.url}/#/find")
    page.wait_for_selector("[data-screen=find]")


def test_no_foreign_page_makes_the_lamp_shine(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("403", "/api/preview")
    rest(real.rig)  # the page of the test before is closed
    frames = real.rig.world.frames
    page = open_page("about:blank")
    page.set_content(f'<img src="{real.url}/api/preview?after=0">')
    assert page.evaluate("document.images[0].decode().then(() => 1, () => 0)") == 0
    page.evaluate(f"fetch('{real.url}/api/preview', {{ mode: 'no-cors' }}).catch(() => 0)")
    with_key = f"fetch('{real.url}/api/preview', {{ headers: {{ 'X-Controller': 'a' }} }}).then(() => 1, () => 0)"
    assert page.evaluate(with_key) == 0
    assert real.rig.world.frames == frames
