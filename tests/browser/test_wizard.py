"""A technician with a tablet calibrates the simulated head on the real server: mishaps, power cuts, wrong PINs."""

import re
import shutil
import signal
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Page, expect

from device.calibration.archive import Archive
from tests.browser.axe import axe_faults
from tests.browser.conftest import PLANS, Complaints, Server
from tests.browser.looks import SIZES, look_for_faults

pytestmark = pytest.mark.browser

PIN = "2580"
HEAD = """\
name = "Head on the bench"

[camera]
backend = "sim"
rows = 270
cols = 480
pitch_um = 20.16
full_well_e = 23000
read_noise_e = 1.03
exposure_s = 0.005
preview_exposure_s = 0.005

[light]
backend = "sim"

[optics]
iris_um = 3200
diffuser_to_sensor_um = 6000
angular_magnification = 0.75
field_deg = 33.4

[calibration]
archive = "archive"

[sim]
object = { kind = "point" }
sensor = { prnu = 0.01, dsnu_e = 2.0, hot_pixels = 0.0003 }
"""
SMALL_PLANS = PLANS.with_name("browser-plans-small")
SHAPES = [SIZES["tablet"], SIZES["portrait"], SIZES["phone"]]
# A server that is killed cuts an answer off wherever it is.
CUT = (
    "ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_INCOMPLETE_CHUNKED", "ERR_EMPTY_RESPONSE", "ERR_SOCKET",
    "ERR_CONTENT_LENGTH_MISMATCH",
)  # fmt: skip
WORDS = {"cap": "The cap is on", "screen": "The screen is there", "point": "The point is there"}
Open = Callable[..., Page]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real server for a head that was never calibrated."""
    folder = tmp_path_factory.mktemp("workshop")
    (folder / "head.toml").write_text(HEAD)
    server = Server(folder / "data", str(folder / "head.toml"))
    if SMALL_PLANS.is_dir():
        shutil.copytree(SMALL_PLANS, server.data / "plans")
    server.start()
    server.wait_until_ready()
    yield server
    server.close()
    if (server.data / "plans").is_dir():
        shutil.copytree(server.data / "plans", SMALL_PLANS, dirs_exist_ok=True)


def archive_of(server: Server) -> Archive:
    return Archive(server.data.parent / "archive")


def come_in(page: Page) -> None:
    """Tap the PIN, whether it is the first or not."""
    page.wait_for_selector("[data-view=door]")
    for digit in PIN:
        page.get_by_role("button", name=digit, exact=True).tap()
    page.locator("#enter").tap()
    expect(page.locator(".place")).not_to_have_attribute("data-view", re.compile("door|opening"), timeout=30_000)


def start(page: Page) -> None:
    page.wait_for_selector("[data-view=overview], [data-view=done]")
    if page.locator("#overview").count():  # the end of the last one, which this tablet has not seen
        page.locator("#overview").tap()
    page.locator("#by").fill("Ada Lovelace")
    expect(page.locator("#start")).to_have_attribute("aria-disabled", "false", timeout=60_000)
    page.wait_for_timeout(700)  # a double tap must not start anything
    page.locator("#start").tap()


def asked(page: Page, stand: str) -> None:
    page.wait_for_selector(f"[data-state=asking] li[data-stand={stand}][data-state=now]", timeout=30_000)
    expect(page.locator("#go")).to_contain_text(WORDS[stand])


def go(page: Page) -> None:
    page.wait_for_timeout(700)
    page.locator("#go").tap()


def practise(page: Page, mishap: str) -> None:
    if not page.locator("#mishap").is_visible():
        page.locator(".practise summary").tap()
    page.locator("#mishap").select_option(mishap)


def faults_in_all_shapes(page: Page, *in_view: str) -> list[str]:
    found = []
    for width, height in SHAPES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(100)
        found += [f"{width}: {fault}" for fault in look_for_faults(page, *in_view)]
    page.set_viewport_size(dict(zip(("width", "height"), SIZES["tablet"], strict=True)))  # type: ignore[arg-type]
    return found + axe_faults(page)


def test_the_wizard_opens_itself_and_calibrates_with_every_mishap(
    workshop: Server, open_page: Open, complaints: Complaints
) -> None:
    complaints.expect("423", "403", "422")
    screener = open_page(workshop.url)
    expect(screener.locator(".state-bar")).to_have_attribute("data-code", "cal.missing")
    screener.context.close()

    page = open_page(f"{workshop.url}/technician")
    page.wait_for_selector("[data-view=door]")
    assert faults_in_all_shapes(page, "#enter") == []
    page.locator("#pin").fill("12")
    page.locator("#enter").tap()
    expect(page.locator(".alert")).to_have_attribute("data-code", "pin.short")
    expect(page.locator("#pin")).to_have_value("12")  # to be gone on with
    page.locator("#pin").fill("")
    come_in(page)
    expect(page.locator(".alert")).to_have_attribute("data-code", "calibration.missing")
    assert faults_in_all_shapes(page) == []
    start(page)

    mishaps = {
        "cap": {"lamp on": "lamp was on in frame", "cap off": "dark frames are bright"},
        "screen": {"cap on": "it is dark", "finger": "differs by", "other mode": "(135, 240)"},
        "point": {"too bright": "%", "too dark": "%", "moving": "moved by 1.0 pixels"},
    }
    for stand, wrong in mishaps.items():
        asked(page, stand)
        page.wait_for_selector("bench-live[data-frame]")
        for mishap, words in wrong.items():
            practise(page, mishap)
            go(page)
            alert = page.locator(".alert[data-code='calibration.refused']")
            expect(alert).to_contain_text(words if words != "%" else re.compile(r"\d"), timeout=20_000)
            asked(page, stand)  # the same again: nothing can be clicked through
        assert faults_in_all_shapes(page, "#go") == []
        before = page.locator("bench-live").get_attribute("data-frame")
        go(page)
        page.wait_for_selector(f"[data-state=measuring], li[data-stand={stand}][data-state=done], [data-view=done]")
        expect(page.locator(f"bench-live:not([data-frame='{before}']), [data-view=done]").first).to_be_visible()

    page.wait_for_selector("[data-view=done]", timeout=30_000)
    kept = archive_of(workshop).load()
    assert kept.provenance.made_by == "Ada Lovelace"
    expect(page.locator("main")).to_contain_text(kept.calibration.id)
    expect(page.locator("[data-number=gain_e_per_dn]")).to_contain_text(re.compile(r"^5\.[67]\d* e⁻/DN$"))
    expect(page.locator("[data-number=black_dn]")).to_contain_text(re.compile(r"^6[34](\.\d+)? DN$"))
    assert faults_in_all_shapes(page, "header") == []
    page.reload()  # the end is still there
    page.wait_for_selector("[data-view=done]")
    page.locator("#overview").tap()
    expect(page.locator(".card").first).to_contain_text(kept.calibration.id)


def test_a_power_cut_at_every_step_keeps_the_steps_before_it_and_the_old_calibration(
    workshop: Server, open_page: Open, complaints: Complaints
) -> None:
    complaints.expect("401", *CUT)
    archive = archive_of(workshop)
    old = archive.current()
    page = open_page(f"{workshop.url}/technician")
    come_in(page)
    for done, stand in enumerate(WORDS):
        start(page)
        if done:
            before = list(WORDS)[done - 1]
            asked(page, before)
            go(page)
        asked(page, stand)
        expect(page.locator(f"li[data-stand={stand}] .last")).to_contain_text("last time")
        page.reload()  # neither a reload nor another tablet changes anything
        asked(page, stand)
        go(page)
        page.wait_for_selector("[data-state=measuring]")
        workshop.signal(signal.SIGKILL)
        expect(page.locator(".lost")).to_be_visible(timeout=10_000)
        workshop.stop()
        workshop.start()
        workshop.wait_until_ready()
        assert archive.current() == old
        come_in(page)
        assert done == 0 or page.locator(".kept").is_visible()
    start(page)
    asked(page, "point")
    expect(page.locator("li[data-state=done]")).to_have_count(2)
    go(page)
    page.wait_for_selector("[data-view=done]", timeout=30_000)
    assert archive.current() != old

    page.locator("#overview").tap()
    expect(page.locator("#start")).to_have_attribute("aria-disabled", "false", timeout=60_000)
    page.wait_for_timeout(700)
    page.locator(f"[data-id='{old}']").tap()
    expect(page.locator(".card").first).to_contain_text(old, timeout=30_000)
    assert archive.current() == old


def test_a_wrong_pin_waits_and_the_door_can_be_shut(workshop: Server, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("403", "401")
    page = open_page(f"{workshop.url}/technician")
    come_in(page)
    while page.locator("[data-view=door]").count() == 0:  # a tap within 0.6 s of a new view does not count
        page.locator("#lock").tap()
        page.wait_for_timeout(700)
    page.wait_for_timeout(700)
    page.keyboard.press("Tab")
    page.locator("#pin").fill("0000")
    page.keyboard.press("Enter")
    expect(page.locator(".alert")).to_have_attribute("data-code", "technician.pin")
    expect(page.locator("#pin")).to_have_value("")
    expect(page.locator("#enter")).to_have_text("Open")
    page.wait_for_timeout(700)
    page.locator("#pin").fill("1111")  # the second wrong one costs two seconds, long enough to be seen
    page.keyboard.press("Enter")
    expect(page.locator("#enter")).to_contain_text("Wait")
    expect(page.locator("#enter")).to_have_text("Open")
    page.wait_for_timeout(700)
    come_in(page)
