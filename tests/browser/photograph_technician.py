"""Screenshots of the technician page in English: `python -m tests.browser.photograph_technician FOLDER`.

Login, calibration step by step, health with and without failures, accuracy against time, event log, software update; in
each size.
"""

import argparse
import json
import urllib.request
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import expect, sync_playwright

from services.health.checks import run_checks
from tests.browser.conftest import CHROMIUM, Server, copy_small_plans
from tests.browser.looks import SIZES
from tests.browser.photograph import Camera
from tests.browser.test_calibration_wizard import HEAD, log_in, measure, start, wait_for_step
from tests.browser.test_technician_sections import MEASURED, health_answer, open_section
from tests.unit.test_checks import HEALTHY

ILL = replace(HEALTHY, battery=0.04, people_left=3)


def sections(camera: Camera, server: Server) -> None:
    """Save screenshots of each section, and of a failed health check."""
    page = camera.page
    page.goto(f"{server.url}/technician")
    log_in(page)
    page.wait_for_selector("[data-view=overview], [data-view=done]")
    if page.locator("#overview").count():  # result of a calibration that this browser has not dismissed
        camera.tap("#overview")
    camera.take("calibration", "[data-view=overview]")
    for section, ready in (
        ("health", "li[data-check]"),
        ("accuracy", "accuracy-time svg"),
        ("event-log", ".event-log li"),
        ("update", ".update"),
    ):
        open_section(page, section)
        camera.take(section, ready)
        page.screenshot(path=camera.folder / f"{section}-whole.png", full_page=True)
    open_section(page, "accuracy")
    page.locator("tbody tr button").last.tap()
    expect(page.locator("eye-pic").nth(1)).to_have_attribute("data-mark", "final", timeout=60_000)
    page.screenshot(path=camera.folder / "accuracy-beside-whole.png", full_page=True)
    page.route("**/api/health", lambda route: route.fulfill(json=health_answer(run_checks(ILL))))
    open_section(page, "health")
    camera.take("health-ill", "li[data-ok=false]")
    camera.tap("#report-code")
    page.screenshot(path=camera.folder / "health-ill-whole.png", full_page=True)
    page.unroute("**/api/health")
    open_section(page, "event-log")
    camera.tap("#to-usb")
    page.locator(".event-log summary").first.tap()
    camera.take("event-log-open", "[role=note]:not(:empty)")


def calibration(camera: Camera) -> None:
    """Save screenshots of each calibration step and of the result."""
    page = camera.page
    open_section(page, "calibration")
    start(page)
    for stand in ("cap", "screen", "point"):
        wait_for_step(page, stand)
        camera.take(f"step-{stand}", "bench-live[data-frame]")
        measure(page)
    camera.take("done", "[data-view=done]")
    camera.tap("#lock")


def main() -> None:
    """Save the screenshots in each size, on a new server."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", choices=sorted(SIZES), action="append")
    arguments = parser.parse_args()
    with TemporaryDirectory() as scratch, sync_playwright() as playwright:
        here = Path(scratch)
        (here / "head.toml").write_text(HEAD)
        server = Server(here / "data", str(here / "head.toml"))
        copy_small_plans(server.data)
        (server.data / "accuracy").mkdir(parents=True)
        (server.data / "accuracy" / "frontier.json").write_text(json.dumps(MEASURED))
        server.start()
        try:
            server.wait_until_ready()
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            for size in arguments.size or SIZES:
                width, height = SIZES[size]
                viewport = {"width": width, "height": height}
                context = browser.new_context(viewport=viewport, has_touch=True, is_mobile=True)  # type: ignore[arg-type]
                camera = Camera(context.new_page(), arguments.folder / size)
                if size == next(iter(arguments.size or SIZES)):
                    camera.page.goto(f"{server.url}/technician")
                    log_in(camera.page)
                    calibration(camera)
                    take_test_picture(server)
                sections(camera, server)
                context.close()
        finally:
            server.close()


def take_test_picture(server: Server) -> None:
    """Take one picture for the sections that show one."""
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(f"{server.url}/api/captures", json.dumps({"eye": "OD"}).encode(), headers)
    urllib.request.urlopen(request, timeout=90).close()


if __name__ == "__main__":
    main()
