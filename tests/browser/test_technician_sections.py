"""Sections of the technician page on the real server: health, accuracy against time, event log."""

import json
import re
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from services.health.checks import CHECKS, Check, run_checks
from tests.browser.axe import axe_faults
from tests.browser.conftest import Server, copy_small_plans
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.test_calibration_wizard import HEAD, log_in
from tests.unit.test_checks import FAULTS, HEALTHY

pytestmark = pytest.mark.browser

Open = Callable[..., Page]
VOICES = Path(__file__).with_name("voices.js")
POINTS = [
    {"method": "tikhonov", "bin": 1, "rounds": 0, "seconds_median": 0.020, "psnr_db": 27.1, "pareto": False},
    {"method": "gradient", "bin": 2, "rounds": 0, "seconds_median": 0.004, "psnr_db": 28.0, "pareto": True},
    {"method": "variation", "bin": 2, "rounds": 8, "seconds_median": 0.090, "psnr_db": 31.5, "pareto": True},
]
PLOT_PX = 960
MEASURED = {
    "scene": "A scene",
    "measured_at": "2026-11-01T09:30:00+00:00",
    "budget_s": 0.26,
    "points": POINTS,
}


@pytest.fixture(scope="module")
def technician_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real server with one capture and a stored accuracy-time measurement."""
    folder = tmp_path_factory.mktemp("sections")
    (folder / "head.toml").write_text(HEAD.split("[calibration]")[0] + "[sim]\n")
    server = Server(folder / "data", str(folder / "head.toml"))
    copy_small_plans(server.data)
    (server.data / "accuracy").mkdir(parents=True)
    (server.data / "accuracy" / "frontier.json").write_text(json.dumps(MEASURED))
    drawing = f'<svg xmlns="http://www.w3.org/2000/svg" width="{PLOT_PX}" height="300"><title>plot</title></svg>'
    (server.data / "accuracy" / "frontier.svg").write_text(drawing)
    server.start()
    server.wait_until_ready()
    body = json.dumps({"eye": "OD"}).encode()
    press = urllib.request.Request(f"{server.url}/api/captures", body, {"Content-Type": "application/json"})
    assert urllib.request.urlopen(press, timeout=90).status == 201
    yield server
    server.close()


@pytest.fixture
def technician_page(open_page: Open, technician_server: Server, complaints: object) -> Page:
    page = open_page(f"{technician_server.url}/technician", SIZES["portrait"])
    log_in(page)
    page.wait_for_timeout(700)
    return page


def open_section(page: Page, section: str) -> None:
    page.locator(f"[data-section={section}]").tap()
    expect(page.locator(f"[data-section={section}]")).to_have_attribute("aria-current", "page")


def layout_faults(page: Page, ready: str) -> list[str]:
    found = []
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_selector(ready)
        found += [f"{name}: {fault}" for fault in look_for_faults(page)]
    return found + axe_faults(page)


def test_health_lists_every_check(technician_page: Page) -> None:
    open_section(technician_page, "health")
    checks = technician_page.locator("li[data-check]")
    expect(checks).to_have_count(len(CHECKS))
    assert {check.get_attribute("data-ok") for check in checks.all()} == {"true"}
    assert layout_faults(technician_page, "li[data-check]") == []


WORDS = {"captures": "Pictures", "audit_log": "Audit log"}  # of a check whose name is not its label


def test_failed_check_is_announced_and_spoken(open_page: Open, technician_server: Server, complaints: object) -> None:
    """The real checks judge modified values; the page announces a failed check in a live region and speaks it."""
    page = open_page("about:blank", SIZES["portrait"])
    page.context.add_init_script(path=VOICES)
    checks: list[Check] = run_checks(HEALTHY)
    page.route("**/api/health", lambda route: route.fulfill(json=health_answer(checks)))
    page.goto(f"{technician_server.url}/technician")
    log_in(page)
    page.wait_for_timeout(700)
    assert {name for name, _ in FAULTS} == {check.name for check in checks} - {"light_limits"}  # which never fails
    spoken = []
    for name, change in FAULTS:
        checks = run_checks(replace(HEALTHY, **change))
        (failed,) = (check for check in checks if not check.ok)
        open_section(page, "calibration")
        open_section(page, "health")
        line = page.get_by_role("status").locator("li[data-ok=false]")
        expect(line).to_have_attribute("data-check", name)
        expect(line).to_contain_text(failed.remedy)
        expect(page.locator("li[data-ok=true]")).to_have_count(len(CHECKS) - 1)
        line.get_by_role("button").tap()
        spoken.append({"text": f"{WORDS.get(name, name.capitalize())}. {failed.remedy}", "lang": "en-GB"})
    assert [utterance for utterance in page.evaluate("spoken") if "lang" in utterance] == spoken
    assert layout_faults(page, "li[data-ok=false]") == []


def test_remedy_without_voice_is_shown_large(open_page: Open, technician_server: Server, complaints: object) -> None:
    page = open_page(f"{technician_server.url}/technician", SIZES["phone"])
    page.route(
        "**/api/health", lambda route: route.fulfill(json=health_answer(run_checks(replace(HEALTHY, battery=0.04))))
    )
    log_in(page)
    page.wait_for_timeout(700)
    open_section(page, "health")
    page.get_by_role("button", name="This tablet cannot speak. Show large: Battery").tap()
    remedy = page.get_by_text("Charge the device before the next patient.")
    expect(remedy).to_have_css("font-size", "40.5px")
    assert layout_faults(page, "li[data-ok=false]") == []


def health_answer(checks: list[Check]) -> dict[str, Any]:
    return {"ok": all(check.ok for check in checks), "checks": [asdict(check) for check in checks]}


def test_capture_is_recomputed_and_time_limit_is_stored(technician_page: Page) -> None:
    open_section(technician_page, "accuracy")
    expect(technician_page.locator("tbody tr")).to_have_count(2)  # the Pareto front
    technician_page.get_by_label("Also list what something better beats").tap()
    expect(technician_page.locator("tbody tr")).to_have_count(3)
    plot = technician_page.locator("img.plot")
    expect(plot).to_have_js_property("complete", True)
    assert plot.evaluate("plot => plot.naturalWidth") == PLOT_PX
    technician_page.locator("tbody tr", has_text="variation").get_by_role("button").tap()
    kept, again = technician_page.locator("eye-pic").nth(0), technician_page.locator("eye-pic").nth(1)
    expect(again).to_have_attribute("data-mark", "final")
    technician_page.get_by_role("button", name="2×").tap()
    expect(again).to_have_attribute("data-zoom", "2.00")
    again.focus()
    technician_page.keyboard.press("+")
    expect(kept).to_have_attribute("data-zoom", "3.00")
    assert layout_faults(technician_page, "eye-pic >> nth=1") == []
    technician_page.get_by_role("button", name="Grey").tap()
    expect(technician_page.get_by_role("button", name="Grey")).to_have_attribute("aria-pressed", "true")
    choices = technician_page.get_by_role("group", name="How long a picture may take").get_by_role("button")
    of_name = {"Grey": "0.26", "Quick": "1", "Standard": "5"}
    expect(choices).to_have_text([f"{name} up to {s} s after the last frame" for name, s in of_name.items()])
    technician_page.reload()
    open_section(technician_page, "accuracy")
    expect(technician_page.get_by_role("button", name="Grey")).to_have_attribute("aria-pressed", "true")


def test_event_log_lists_events(technician_page: Page) -> None:
    open_section(technician_page, "event-log")
    expect(technician_page.locator(".event-log li").first).to_be_visible()
    text = technician_page.locator(".event-log").inner_text()
    assert "a picture was made in" in text
    assert "started, version" in text
    assert layout_faults(technician_page, ".event-log li") == []


def test_event_log_is_filtered_and_exported(technician_page: Page) -> None:
    stick = {"id": "0123456789abcdef", "name": "BLUE", "free_bytes": 10**9, "is_writable": True}
    locked = {**stick, "id": "fedcba9876543210", "name": "LOCKED", "is_writable": False}
    technician_page.route("**/api/exports", lambda route: route.fulfill(json={"folders": [locked, stick]}))
    technician_page.route("**/event-log/export", lambda route: route.fulfill(json={"folder": "event-log-2026-11-22"}))
    open_section(technician_page, "event-log")
    with technician_page.expect_download() as saved:
        technician_page.get_by_role("link", name="Save as a file").tap()
    assert "a picture was made in" in Path(saved.value.path()).read_text()
    technician_page.get_by_role("button", name="Copy to USB").tap()
    expect(technician_page.get_by_role("button", name="LOCKED (read-only)")).to_be_disabled()
    with technician_page.expect_request("**/event-log/export") as asked:
        technician_page.get_by_role("button", name="BLUE").tap()
    assert asked.value.post_data_json == {"folder": stick["id"]}
    expect(technician_page.get_by_role("note")).to_have_text("Copied to BLUE/event-log-2026-11-22.")
    entry = technician_page.locator(".event-log li", has_text="a picture was made in")
    entry.get_by_text("More").tap()
    entry.get_by_role("button", name="Only this picture").tap()
    expect(technician_page.get_by_text("Only what is about")).to_be_visible()
    expect(technician_page.locator(".event-log li", has_text="started, version")).to_have_count(0)
    technician_page.get_by_role("button", name="Everything").tap()
    expect(technician_page.locator(".event-log li", has_text="started, version").first).to_be_visible()


def test_health_report_is_copied_saved_and_shown_as_qr_code(technician_page: Page) -> None:
    open_section(technician_page, "health")
    text = technician_page.get_by_label("Report for whoever helps")
    expect(text).to_have_value(re.compile(r"ok  Lamp: dark\n.*drawn by: the \w+", re.DOTALL))
    with technician_page.expect_download() as saved:
        technician_page.locator("#report-save").tap()
    assert "ok  Pictures: safe" in Path(saved.value.path()).read_text()
    technician_page.locator("#report-copy").tap()
    expect(technician_page.get_by_role("note")).to_have_text("Copied.")
    technician_page.locator("#report-code").tap()
    expect(technician_page.get_by_role("img", name="The report as a code for a telephone")).to_be_visible()
    assert layout_faults(technician_page, ".report svg") == []


def test_a_passphrase_is_set_before_the_first_backup(technician_page: Page) -> None:
    open_section(technician_page, "backup")
    section = technician_page.locator("instrument-backup")
    expect(section.get_by_role("status")).to_have_text("There is no backup yet.")
    first, second = section.locator("input").all()
    first.fill("four plain words here")
    second.fill("four plain words hers")
    section.get_by_role("button").tap()
    expect(section.get_by_role("alert")).to_have_text("The two passphrases differ.")
    assert layout_faults(technician_page, "instrument-backup form") == []
    second.fill("four plain words here")
    section.get_by_role("button").tap()
    expect(section.get_by_role("note")).to_contain_text("The passphrase is set.")
    section.locator("#back-up").tap()
    expect(section.get_by_role("note")).to_contain_text("stick")
    assert layout_faults(technician_page, "#back-up") == []


def test_there_is_nothing_to_remove_before_a_visit_was_exported(technician_page: Page) -> None:
    open_section(technician_page, "space")
    section = technician_page.locator("stored-pictures")
    expect(section.get_by_role("status")).to_have_text("There is nothing to remove.")
    expect(section.get_by_role("button")).to_have_count(0)
    assert layout_faults(technician_page, "stored-pictures p") == []
