"""Screenshots of every screen and state for visual review: `python -m tests.browser.photograph FOLDER`.

One PNG per language, size, screen and state; `--language` and `--size` select.
"""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import Page, ViewportSize, sync_playwright

from tests.browser.alert_causes import CAUSES, StandingAlerts, alert
from tests.browser.conftest import CHROMIUM
from tests.browser.looks import SIZES
from tests.browser.real import POOR, Instruments, Real
from tests.browser.walk import stay, tap

LANGUAGES = ["en", "en-XA", "ta", "hi", "te"]


class Camera:
    """Numbered screenshots of one page in a folder."""

    def __init__(self, page: Page, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.page, self.folder, self._count = page, folder, 0

    def take(self, name: str, ready: str | None = None) -> None:
        """Save a screenshot, after waiting for the selector `ready` and 0.5 s for fades."""
        if ready:
            self.page.wait_for_selector(ready)
            self.page.wait_for_timeout(500)
        if name not in ("patient-urgent", "slip"):
            self.page.evaluate("scrollTo(0, 0)")
        self._count += 1
        self.page.screenshot(path=self.folder / f"{self._count:02d}-{name}.png")

    def tap(self, selector: str) -> None:
        tap(self.page, selector)


def photograph(page: Page, real: Real, standing: StandingAlerts, folder: Path) -> None:
    """Save screenshots of all screens and of each state in between."""
    camera = Camera(page, folder)

    def at(place: str, mark: str, name: str, of: Real = real) -> None:
        page.goto(f"{of.url}/#/{place}")
        camera.take(name, mark)

    at("", "#new", "home-empty")
    visit = real.begin_visit(consent="agreed", sex="woman", age=54, complaints=["flashes"], diabetes="yes")["id"]
    at("find", ".people", "find")
    for digit in "0013":
        page.locator(f"[data-key='{digit}']").tap()
    camera.take("find-choose", "#start:not([hidden])")
    page.locator("[data-key='9']").tap()
    page.locator(".people").wait_for(state="detached")
    camera.take("find-no-match", "#start:not([hidden])")
    at(f"visit/{visit}/patient", ".patient", "patient")
    page.locator("[data-field=complaints] [data-value=pain]").tap()
    page.locator(".urgent").scroll_into_view_if_needed()
    camera.take("patient-urgent")
    page.locator("[data-field=complaints] [data-value=pain]").tap()
    for code in standing.CODES:
        standing.open(page, code)
        camera.take(code)
    at(f"visit/{visit}/aim/R-centre", "eye-live[data-frame]", "aim")
    states(camera, real)
    camera.tap("#not-possible")
    camera.take("why", ".reasons")
    camera.tap("#not-asked")
    shots(camera, real)
    after(camera, real, visit, at)
    sending = standing.instrument("send.stuck")
    at("", "#send", "home-sending", sending)
    at("send", ".send .people li", "send", sending)
    at(f"visit/{sending.visits()[-1]['id']}/outcome", "#by-itself", "outcome-sending", sending)


def states(camera: Camera, real: Real) -> None:
    """Save screenshots of all alerts, aiming hints and the menu."""
    page, faults = camera.page, real.rig.world.faults
    for code in CAUSES:
        with alert(real, page, code):
            camera.take(code)
    faults.add("eye.closed")
    page.wait_for_timeout(1500)
    camera.take("aim-noeye")
    faults.clear()
    for cause in ("pupil", "saturated", "dark"):
        with real.poor_light(cause):
            page.wait_for_timeout(1500)
            camera.take(f"aim-{cause}")
    page.wait_for_selector(".prompt[data-tone=ready]")
    camera.tap("#open-menu")
    camera.take("menu", "dialog[open]")
    page.keyboard.press("Escape")


def shots(camera: Camera, real: Real) -> None:
    """Save screenshots of a capture: in progress, assessed, each poor verdict, retakes exhausted, good."""
    page = camera.page
    address = page.url
    for cause in POOR:
        real.hold = "expose" if cause == "dark" else None  # too bright a frame has no quick look
        visit = real.begin_visit(consent="agreed", sex="woman", age=54)["id"]
        page.goto(f"{real.url}/#/visit/{visit}/aim/R-centre")
        page.wait_for_selector("eye-live[data-frame]")
        real.show(cause)
        camera.tap("#shutter")
        stay(page)
        if real.hold:
            camera.take("making", "[data-phase=making]")
            real.hold = "quick"
            camera.take("assessed", "[data-phase=assessed]")
            real.hold = None
        camera.take(f"shot-{cause}", "[data-phase=kept] .stage[data-mark=final]")
        real.show(None)
        for _ in range(3):  # good pictures keep the calibration in force
            real.request("POST", "/api/captures", eye="OD")
    real.show("saturated")
    page.goto(address)
    for _ in range(3):
        camera.tap("#shutter")
        page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
        camera.take("shot-poor") if page.locator("#not-possible").count() else None
        camera.tap("#again")
    real.show(None)
    camera.tap("#shutter")
    camera.take("good-goes-on", "[data-phase=kept] [data-verdict=good] #result-title")
    camera.take("aim-went-on", "[data-code='shot.next']")
    camera.tap("[data-do=showAgain]")
    camera.take("good", "[data-phase=kept] [data-verdict=good] #result-title")
    camera.tap("#open-details")
    camera.take("details", "#details[open]")
    page.keyboard.press("Escape")


def after(camera: Camera, real: Real, visit: str, at: Callable[[str, str, str], None]) -> None:
    """Save screenshots of the rest of the visit, its outcome, and history."""
    page = camera.page
    for hold in (None, "stored"):
        camera.tap("#next")
        real.hold = hold
        camera.tap("#shutter")
        stay(page)
        page.wait_for_selector("[data-phase=assessed]" if hold else "[data-phase=kept] .stage[data-mark=final]")
    camera.tap("#finish")
    camera.take("finish-question", "#finish-without")
    camera.tap("#finish-without")
    camera.take("finishing", "#finishing progress")
    real.hold = None
    camera.take("outcome", "#done")
    camera.tap("#code")
    camera.take("outcome-code", ".outcome > figure.code")
    page.emulate_media(media="print")
    camera.take("slip")
    page.emulate_media(media="screen")
    declined = real.begin_visit(consent="declined")["id"]
    at(f"visit/{declined}/patient", ".patient", "declined")
    camera.tap("#finish")
    camera.take("outcome-refer", ".outcome")
    real.begin_visit(consent="agreed", sex="man", age=61)
    at("", "#continue", "home")
    at("history", ".history [data-visit]", "history")
    real.mount()
    at(f"visit/{visit}/pictures", ".pictures li", "pictures")
    for pick in page.locator(".pick").all()[:2]:
        pick.tap()
    camera.tap("#copy")
    camera.take("pictures-picked", "[data-folder]")
    camera.tap("#compare")
    camera.take("compare", ".two figure:last-child [data-mark=final]")
    page.locator("[data-value=true]").tap()
    camera.take("compare-over", "#swap")


def main() -> None:
    """Save the selected screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--language", choices=LANGUAGES, action="append")
    parser.add_argument("--size", choices=sorted(SIZES), action="append")
    arguments = parser.parse_args()
    with TemporaryDirectory() as scratch, ExitStack() as undo, sync_playwright() as playwright:
        numbers = count()
        instruments = Instruments(lambda: Path(scratch) / str(next(numbers)))
        undo.callback(instruments.close)
        standing = StandingAlerts(instruments, undo)
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for language in arguments.language or LANGUAGES:
            for size in arguments.size or SIZES:
                real = instruments.build(binning=4)
                width, height = SIZES[size]
                viewport = ViewportSize(width=width, height=height)
                context = browser.new_context(viewport=viewport, has_touch=True, is_mobile=True)
                context.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")
                photograph(context.new_page(), real, standing, arguments.folder / language / size)
                context.close()
                real.close()


if __name__ == "__main__":
    main()
