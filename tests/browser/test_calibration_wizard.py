"""Calibration of the simulated head on the real server: injected faults, power cuts, wrong PINs, trial lenses."""

import re
import shutil
import signal
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from device.calibration.archive import Archive, Provenance
from device.clock import VirtualClock
from device.config.head_file import load_head
from device.sim.simulated_calibration import simulated_calibration
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate
from tests.browser.axe import axe_faults
from tests.browser.conftest import SMALL_PLANS, Complaints, Server, copy_small_plans
from tests.browser.looks import SIZES, look_for_faults
from tests.simulated import small_head_toml, world

pytestmark = pytest.mark.browser

TABLES = """\
[calibration]
archive = "archive"

[sim]
object = { kind = "point" }
sensor = { prnu = 0.01, dsnu_e = 2.0, hot_pixels = 0.0003 }
"""
HEAD = small_head_toml("Head on the bench", TABLES, exposure_s=0.005)
# Few pixels, with many electrons each, that measure every lens within the limits; their PSF is off by 0.2 dpt.
LENS_TABLES = TABLES.replace("[sim]\n", "[sim]\npeak_e = 690000\ncalibration = { m_dpt = 0.2 }\n").replace(
    '{ kind = "point" }', "{ haemorrhages = 3 }"
)
LENS_HEAD = (
    small_head_toml("Head for lenses", LENS_TABLES, exposure_s=0.005)
    .replace("rows = 270", "rows = 158")
    .replace("cols = 480", "cols = 282")
    .replace("20.16", "34.27")
    .replace("full_well_e = 23000", "full_well_e = 1060000\nbit_depth = 16")
    .replace('backend = "sim"\n\n[optics]', 'backend = "sim"\npreview_colour = "green"\n\n[optics]')
)
SHAPES = [SIZES["tablet"], SIZES["portrait"], SIZES["phone"]]
# Network errors while the server is killed.
CUT = (
    "ERR_CONNECTION_REFUSED",
    "ERR_CONNECTION_RESET",
    "ERR_INCOMPLETE_CHUNKED",
    "ERR_EMPTY_RESPONSE",
    "ERR_SOCKET",
    "ERR_CONTENT_LENGTH_MISMATCH",
)
WORDS = {"cap": "The cap is on", "screen": "The screen is there", "point": "The point is there"}
Open = Callable[..., Page]


@pytest.fixture
def uncalibrated_server(tmp_path: Path) -> Iterator[Server]:
    """A real server for a head that was never calibrated."""
    folder = tmp_path
    (folder / "head.toml").write_text(HEAD)
    server = Server(folder / "data", str(folder / "head.toml"))
    copy_small_plans(server.data)
    server.start()
    server.wait_until_ready()
    yield server
    server.close()
    if (server.data / "plans").is_dir():
        shutil.copytree(server.data / "plans", SMALL_PLANS, dirs_exist_ok=True)


def calibrate_once(server: Server) -> str:
    """Calibrate the head of a server without its page; return the id of the calibration in force."""
    archive = archive_of(server)
    spec = load_head(server.data.parent / "head.toml")
    calibrate(spec, CalibrationRequest(archive.root, None, "Ada", None), VirtualClock(), [].append, [].append)
    return archive.active_id()


def archive_of(server: Server) -> Archive:
    return Archive(server.data.parent / "archive")


def log_in(page: Page) -> None:
    """Wait until the page of the demonstration user shows the calibration."""
    expect(page.locator(".place")).not_to_have_attribute("data-view", "opening", timeout=120_000)


def start(page: Page) -> None:
    page.wait_for_selector("[data-view=overview], [data-view=done]")
    if page.locator("#overview").count():  # result of a calibration that this browser has not dismissed
        page.locator("#overview").tap()
    page.locator("#by").fill("Ada Lovelace")
    expect(page.locator("#start")).to_have_attribute("aria-disabled", "false")
    page.wait_for_timeout(700)  # debounce of the page
    page.locator("#start").tap()


def wait_for_step(page: Page, stand: str) -> None:
    page.wait_for_selector(f"[data-state=asking] li[data-stand={stand}][data-state=now]")
    expect(page.locator("#go")).to_contain_text(WORDS[stand])


def measure(page: Page) -> None:
    page.wait_for_timeout(700)
    page.locator("#go").tap()


def select_fault(page: Page, mishap: str) -> None:
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


def test_calibration_with_every_fault(uncalibrated_server: Server, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("423", "403", "422")
    screener = open_page(uncalibrated_server.url)
    expect(screener.locator(".state-bar")).to_have_attribute("data-code", "cal.missing")
    screener.context.close()

    page = open_page(f"{uncalibrated_server.url}/technician")
    log_in(page)
    expect(page.locator(".alert")).to_have_attribute("data-code", "calibration.missing")
    assert faults_in_all_shapes(page) == []
    start(page)

    mishaps = {
        "cap": {"lamp on": "lamp was on in frame", "cap off": "dark frames are bright"},
        "screen": {"cap on": "it is dark", "finger": "differs by", "other mode": "(135, 240)"},
        "point": {"too bright": "saturated", "too dark": "too dark", "moving": "moved by 1.0 pixels"},
    }
    for stand, wrong in mishaps.items():
        wait_for_step(page, stand)
        page.wait_for_selector("bench-live[data-frame]")
        for mishap, words in wrong.items():
            select_fault(page, mishap)
            measure(page)
            alert = page.locator(".alert[data-code='calibration.refused']")
            expect(alert).to_contain_text(words)  # of this fault, not of the one before
            wait_for_step(page, stand)  # the same step: faults cannot be skipped
        assert faults_in_all_shapes(page, "#go") == []
        before = page.locator("bench-live").get_attribute("data-frame")
        measure(page)
        page.wait_for_selector(f"[data-state=measuring], li[data-stand={stand}][data-state=done], [data-view=done]")
        expect(page.locator(f"bench-live:not([data-frame='{before}']), [data-view=done]").first).to_be_visible()

    page.wait_for_selector("[data-view=done]")
    kept = archive_of(uncalibrated_server).load()
    assert kept.provenance.made_by == "Ada Lovelace"
    expect(page.locator("main")).to_contain_text(kept.calibration.id)
    expect(page.locator("[data-number=gain_e_per_dn]")).to_contain_text(re.compile(r"^5\.[67]\d* e⁻/DN$"))
    expect(page.locator("[data-number=black_dn]")).to_contain_text(re.compile(r"^6[34](\.\d+)? DN$"))
    assert faults_in_all_shapes(page, "header") == []
    page.reload()  # the result is shown again
    page.wait_for_selector("[data-view=done]")
    page.locator("#overview").tap()
    expect(page.locator(".card").first).to_contain_text(kept.calibration.id)


def test_power_cut_at_every_step_keeps_finished_steps(
    uncalibrated_server: Server, open_page: Open, complaints: Complaints
) -> None:
    complaints.expect("401", *CUT)
    archive = archive_of(uncalibrated_server)
    old = calibrate_once(uncalibrated_server)
    page = open_page(f"{uncalibrated_server.url}/technician")
    log_in(page)
    for done, stand in enumerate(WORDS):
        start(page)
        if done:
            before = list(WORDS)[done - 1]
            wait_for_step(page, before)
            measure(page)
        wait_for_step(page, stand)
        expect(page.locator(f"li[data-stand={stand}] .last")).to_contain_text("last time")
        page.reload()  # a reload does not change the state
        wait_for_step(page, stand)
        measure(page)
        page.wait_for_selector("[data-state=measuring]")
        uncalibrated_server.signal(signal.SIGKILL)
        expect(page.locator(".lost")).to_be_visible(timeout=10_000)
        uncalibrated_server.stop()
        uncalibrated_server.start()
        uncalibrated_server.wait_until_ready()
        assert archive.active_id() == old
        log_in(page)
        assert done == 0 or page.locator(".kept").is_visible()
    start(page)
    wait_for_step(page, "point")
    expect(page.locator("li[data-state=done]")).to_have_count(2)
    measure(page)
    page.wait_for_selector("[data-view=done]")
    assert archive.active_id() != old

    page.locator("#overview").tap()
    expect(page.locator("#start")).to_have_attribute("aria-disabled", "false")
    page.wait_for_timeout(700)
    page.locator(f"[data-id='{old}']").tap()
    expect(page.locator(".card").first).to_contain_text(old)
    assert archive.active_id() == old


@pytest.fixture
def lens_server(tmp_path: Path) -> Iterator[Server]:
    """A real server for a head whose calibration is in force and can be checked with trial lenses."""
    (tmp_path / "head.toml").write_text(LENS_HEAD)
    spec = load_head(tmp_path / "head.toml")
    assert spec.calibration is not None
    made = Provenance("DS-7", datetime.now(UTC), "Ada", "0.1.0")
    Archive(spec.calibration.archive).add_and_activate(simulated_calibration(world(spec)), made)
    server = Server(tmp_path / "data", str(tmp_path / "head.toml"))
    copy_small_plans(server.data)
    server.start()
    server.wait_until_ready()
    yield server
    server.close()


def press(page: Page, name: str) -> None:
    """Press a button by keyboard, after the debounce of the page."""
    page.wait_for_timeout(700)
    page.locator(name).focus()
    page.keyboard.press("Enter")


def test_trial_lenses_by_keyboard_put_the_offset_in_force(
    lens_server: Server, open_page: Open, complaints: Complaints
) -> None:
    complaints.expect("422")
    archive = archive_of(lens_server)
    before = archive.active_id()
    page = open_page(f"{lens_server.url}/technician")
    log_in(page)
    expect(page.locator("#lenses")).to_have_attribute("aria-disabled", "false", timeout=120_000)
    page.locator("form:has(#lenses) summary").tap()
    page.locator("#vertex").fill("far")
    press(page, "#lenses")
    expect(page.locator(".alert")).to_have_attribute("data-code", "input")
    page.locator("#vertex").fill("12,0")
    press(page, "#lenses")
    expect(page.locator("[data-lens='0']")).to_have_attribute("data-state", "now")
    expect(page.locator("[role=status]")).to_have_text("The simulated eye is there, without a lens.")
    press(page, "#cancel")
    page.wait_for_selector("[data-view=overview]")
    assert archive.active_id() == before
    expect(page.locator("#lenses")).to_have_attribute("aria-disabled", "false")
    press(page, "#lenses")
    for k, words in enumerate(("without a lens", "+2.00", "-2.00", "+5.00", "-5.00", "-2.00 × 30°")):
        expect(page.locator(f"[data-lens='{k}']")).to_have_attribute("aria-current", "step")
        expect(page.locator("[role=status]")).to_contain_text(words)
        expect(page.locator("tr[data-state=done]")).to_have_count(k)
        if k == 5:
            assert faults_in_all_shapes(page, "#lens-go") == []
            page.reload()  # a reload loses nothing
            page.wait_for_selector("[data-lens='5'][data-state=now]")
        press(page, "#lens-go")
    page.wait_for_selector("[data-view=lens-result]")
    offset = archive.load().calibration.refraction_offset
    assert offset is not None
    assert archive.active_id() != before
    expect(page.locator("[data-finding]")).to_have_count(9)
    expect(page.locator("[data-finding][data-ok=false]")).to_have_count(0)
    expect(page.locator("[data-finding=offset]")).to_contain_text(f"{offset.m_dpt:+.2f} dpt")
    assert faults_in_all_shapes(page, "header") == []
    press(page, "#overview")
    expect(page.locator("form:has(#lenses)")).to_contain_text(f"{offset.m_dpt:+.2f} dpt is taken from every refraction")
