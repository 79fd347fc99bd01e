"""Photographs of the technician's place, whose words are English: `python -m tests.browser.photograph_rooms FOLDER`.

Door, calibration step by step, health well and ill, how good and how fast, diary, update; each in every size.
"""

import argparse
import json
import shutil
import urllib.request
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import expect, sync_playwright

from services.health.checks import judged
from tests.browser.conftest import CHROMIUM, Server
from tests.browser.looks import SIZES
from tests.browser.photograph import Camera
from tests.browser.test_rooms import MEASURED, answer, enter
from tests.browser.test_wizard import HEAD, SMALL_PLANS, asked, come_in, go, start
from tests.unit.test_checks import WELL

ILL = replace(WELL, battery=0.04, people_left=3)


def rooms(camera: Camera, server: Server) -> None:
    """The door and each room; health is shown well as it is, and ill as it might be."""
    page = camera.page
    page.goto(f"{server.url}/technician")
    camera.take("door", "[data-view=door]")
    page.get_by_role("button", name="2", exact=True).tap()
    camera.tap("#enter")
    camera.take("door-refused", ".alert")
    page.reload()
    come_in(page)
    page.wait_for_selector("[data-view=overview], [data-view=done]")
    if page.locator("#overview").count():  # the end of the calibration, which this tablet has not seen
        camera.tap("#overview")
    camera.take("calibration", "[data-view=overview]")
    for room, ready in (("health", "li[data-check]"), ("explorer", "accuracy-time svg"), ("diary", ".diary li"),
                        ("update", ".update")):  # fmt: skip
        enter(page, room)
        camera.take(room, ready)
        page.screenshot(path=camera.folder / f"{room}-whole.png", full_page=True)
    enter(page, "explorer")
    page.locator("tbody tr button").last.tap()
    expect(page.locator("eye-pic").nth(1)).to_have_attribute("data-mark", "final", timeout=60_000)
    page.screenshot(path=camera.folder / "explorer-beside-whole.png", full_page=True)
    page.route("**/api/health", lambda route: route.fulfill(json=answer(judged(ILL))))
    enter(page, "health")
    camera.take("health-ill", "li[data-ok=false]")
    camera.tap("#report-code")
    page.screenshot(path=camera.folder / "health-ill-whole.png", full_page=True)
    page.unroute("**/api/health")
    enter(page, "diary")
    camera.tap("#to-usb")
    page.locator(".diary summary").first.tap()
    camera.take("diary-open", "[role=note]:not(:empty)")


def calibration(camera: Camera) -> None:
    """Every step, what is wrong with a cap that is off, and the end."""
    page = camera.page
    enter(page, "calibration")
    start(page)
    for stand in ("cap", "screen", "point"):
        asked(page, stand)
        camera.take(f"step-{stand}", "bench-live[data-frame]")
        go(page)
    camera.take("done", "[data-view=done]")
    camera.tap("#lock")


def main() -> None:
    """Photograph every size, on a server of its own."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("folder", type=Path)
    words.add_argument("--size", choices=sorted(SIZES), action="append")
    wish = words.parse_args()
    with TemporaryDirectory() as scratch, sync_playwright() as playwright:
        here = Path(scratch)
        (here / "head.toml").write_text(HEAD)
        server = Server(here / "data", str(here / "head.toml"))
        if SMALL_PLANS.is_dir():
            shutil.copytree(SMALL_PLANS, server.data / "plans")
        (server.data / "explorer").mkdir(parents=True)
        (server.data / "explorer" / "frontier.json").write_text(json.dumps(MEASURED))
        server.start()
        try:
            server.wait_until_ready()
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            for size in wish.size or SIZES:
                width, height = SIZES[size]
                viewport = {"width": width, "height": height}
                context = browser.new_context(viewport=viewport, has_touch=True, is_mobile=True)  # type: ignore[arg-type]
                camera = Camera(context.new_page(), wish.folder / size)
                if size == next(iter(wish.size or SIZES)):
                    camera.page.goto(f"{server.url}/technician")
                    come_in(camera.page)
                    calibration(camera)
                    press(server)
                rooms(camera, server)
                context.close()
        finally:
            server.close()


def press(server: Server) -> None:
    """One picture, for the rooms that show one."""
    headers = {"Content-Type": "application/json"}
    wish = urllib.request.Request(f"{server.url}/api/captures", json.dumps({"eye": "OD"}).encode(), headers)
    urllib.request.urlopen(wish, timeout=90).close()


if __name__ == "__main__":
    main()
