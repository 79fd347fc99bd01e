"""The technician's other rooms on the real server: health, accuracy against time, the diary."""

import json
import re
import shutil
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from services.health.checks import CHECKS, Check, judged
from tests.browser.axe import axe_faults
from tests.browser.conftest import Server
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.test_wizard import HEAD, SMALL_PLANS, come_in
from tests.unit.test_checks import DRIVEN, WELL

pytestmark = pytest.mark.browser

Open = Callable[..., Page]
VOICES = Path(__file__).with_name("voices.js")
POINTS = [
    {"method": "tikhonov", "bin": 1, "rounds": 0, "seconds_median": 0.020, "psnr_db": 27.1, "pareto": False},
    {"method": "gradient", "bin": 2, "rounds": 0, "seconds_median": 0.004, "psnr_db": 28.0, "pareto": True},
    {"method": "variation", "bin": 2, "rounds": 8, "seconds_median": 0.090, "psnr_db": 31.5, "pareto": True},
]
MEASURED = {"scene": "A scene", "measured_at": "2026-11-01T09:30:00+00:00", "budget_s": 0.26, "points": POINTS}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real server with one picture on its shelf, on which a frontier was measured before."""
    folder = tmp_path_factory.mktemp("rooms")
    (folder / "head.toml").write_text(HEAD.split("[calibration]")[0] + "[sim]\n")
    server = Server(folder / "data", str(folder / "head.toml"))
    if SMALL_PLANS.is_dir():
        shutil.copytree(SMALL_PLANS, server.data / "plans")
    (server.data / "explorer").mkdir(parents=True)
    (server.data / "explorer" / "frontier.json").write_text(json.dumps(MEASURED))
    server.start()
    server.wait_until_ready()
    body = json.dumps({"eye": "OD"}).encode()
    press = urllib.request.Request(f"{server.url}/api/captures", body, {"Content-Type": "application/json"})
    assert urllib.request.urlopen(press, timeout=90).status == 201
    yield server
    server.close()


@pytest.fixture
def inside(open_page: Open, rooms: Server, complaints: object) -> Page:
    page = open_page(f"{rooms.url}/technician", SIZES["portrait"])
    come_in(page)
    page.wait_for_timeout(700)
    return page


def enter(page: Page, room: str) -> None:
    page.locator(f"[data-room={room}]").tap()
    expect(page.locator(f"[data-room={room}]")).to_have_attribute("aria-current", "page")


def faults(page: Page, ready: str) -> list[str]:
    found = []
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_selector(ready)
        found += [f"{name}: {fault}" for fault in look_for_faults(page)]
    return found + axe_faults(page)


def test_health_says_of_every_part_how_it_is(inside: Page) -> None:
    enter(inside, "health")
    checks = inside.locator("li[data-check]")
    expect(checks).to_have_count(10)
    assert {check.get_attribute("data-ok") for check in checks.all()} == {"true"}
    assert faults(inside, "li[data-check]") == []


def test_every_check_is_driven_to_its_failure_and_its_remedy_is_read_aloud(
    open_page: Open, rooms: Server, complaints: object
) -> None:
    """The real checks judge spoiled facts; the page tells their words to a screen reader, and says them at a tap."""
    page = open_page("about:blank", SIZES["portrait"])
    page.context.add_init_script(path=VOICES)
    told: list[Check] = judged(WELL)
    page.route("**/api/health", lambda route: route.fulfill(json=answer(told)))
    page.goto(f"{rooms.url}/technician")
    come_in(page)
    page.wait_for_timeout(700)
    assert {name for name, _ in DRIVEN} == {check.name for check in told}
    said = []
    for name, change in DRIVEN:
        told = judged(replace(WELL, **change))
        (failed,) = (check for check in told if not check.ok)
        enter(page, "calibration")
        enter(page, "health")
        line = page.get_by_role("status").locator("li[data-ok=false]")
        expect(line).to_have_attribute("data-check", name)
        expect(line).to_contain_text(failed.remedy)
        expect(page.locator("li[data-ok=true]")).to_have_count(len(CHECKS) - 1)
        line.get_by_role("button").tap()
        said.append({"text": f"{name.capitalize()}. {failed.remedy}".replace("Captures", "Pictures"), "lang": "en-GB"})
    assert [one for one in page.evaluate("spoken") if "lang" in one] == said
    assert faults(page, "li[data-ok=false]") == []


def test_a_remedy_that_no_voice_can_say_is_shown_large(open_page: Open, rooms: Server, complaints: object) -> None:
    page = open_page(f"{rooms.url}/technician", SIZES["phone"])
    page.route("**/api/health", lambda route: route.fulfill(json=answer(judged(replace(WELL, battery=0.04)))))
    come_in(page)
    page.wait_for_timeout(700)
    enter(page, "health")
    page.get_by_role("button", name="This tablet has no voice. Show large: Battery").tap()
    remedy = page.get_by_text("Charge the device before the next patient.")
    expect(remedy).to_have_css("font-size", "40.5px")
    assert faults(page, "li[data-ok=false]") == []


def answer(checks: list[Check]) -> dict[str, Any]:
    return {"ok": all(check.ok for check in checks), "checks": [asdict(check) for check in checks]}


def test_a_capture_is_seen_under_another_method_and_a_pace_is_chosen_to_stay(inside: Page) -> None:
    enter(inside, "explorer")
    expect(inside.locator("tbody tr")).to_have_count(2)  # the best for their time
    inside.get_by_label("Also list what something better beats").tap()
    expect(inside.locator("tbody tr")).to_have_count(3)
    inside.locator("tbody tr", has_text="variation").get_by_role("button").tap()
    kept, again = inside.locator("eye-pic").nth(0), inside.locator("eye-pic").nth(1)
    expect(again).to_have_attribute("data-mark", "final", timeout=60_000)
    inside.get_by_role("button", name="2×").tap()
    expect(again).to_have_attribute("data-zoom", "2.00")
    again.focus()
    inside.keyboard.press("+")
    expect(kept).to_have_attribute("data-zoom", "3.00")
    assert faults(inside, "eye-pic >> nth=1") == []
    inside.get_by_role("button", name="Best").tap()
    expect(inside.get_by_role("button", name="Best")).to_have_attribute("aria-pressed", "true")
    inside.reload()
    enter(inside, "explorer")
    expect(inside.get_by_role("button", name="Best")).to_have_attribute("aria-pressed", "true")


def test_the_diary_tells_what_happened_in_sentences(inside: Page) -> None:
    enter(inside, "diary")
    expect(inside.locator(".diary li").first).to_be_visible()
    said = inside.locator(".diary").inner_text()
    assert "a picture was kept after" in said
    assert "started, version" in said
    assert faults(inside, ".diary li") == []


def test_the_diary_is_read_of_one_picture_and_taken_away(inside: Page) -> None:
    stick = {"id": "/media/BLUE", "name": "BLUE", "free_bytes": 10**9}
    inside.route("**/api/exports", lambda route: route.fulfill(json={"folders": [stick]}))
    inside.route("**/diary/export", lambda route: route.fulfill(json={"folder": "diary-2026-11-22"}))
    enter(inside, "diary")
    with inside.expect_download() as saved:
        inside.get_by_role("link", name="Save as a file").tap()
    assert "a picture was kept after" in Path(saved.value.path()).read_text()
    inside.get_by_role("button", name="Copy to USB").tap()
    with inside.expect_request("**/diary/export") as asked:
        inside.get_by_role("button", name="BLUE").tap()
    assert asked.value.post_data_json == {"folder": "/media/BLUE"}
    expect(inside.get_by_role("note")).to_have_text("Copied to BLUE/diary-2026-11-22.")
    entry = inside.locator(".diary li", has_text="a picture was kept after")
    entry.get_by_text("More").tap()
    entry.get_by_role("button", name="Only this picture").tap()
    expect(inside.get_by_text("Only what is about")).to_be_visible()
    expect(inside.locator(".diary li", has_text="started, version")).to_have_count(0)
    inside.get_by_role("button", name="Everything").tap()
    expect(inside.locator(".diary li", has_text="started, version").first).to_be_visible()


def test_the_report_is_copied_saved_and_shown_as_a_code(inside: Page) -> None:
    enter(inside, "health")
    text = inside.get_by_label("Report for whoever helps")
    expect(text).to_have_value(re.compile(r"ok  Lamp: dark\n.*drawn by: the \w+", re.DOTALL))
    with inside.expect_download() as saved:
        inside.locator("#report-save").tap()
    assert "ok  Pictures: safe" in Path(saved.value.path()).read_text()
    inside.locator("#report-copy").tap()
    expect(inside.get_by_role("note")).to_have_text("Copied.")
    inside.locator("#report-code").tap()
    expect(inside.get_by_role("img", name="The report as a code for a telephone")).to_be_visible()
    assert faults(inside, ".report svg") == []
