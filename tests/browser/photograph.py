"""Photographs of every screen and state, for people to look at: `python -m tests.browser.photograph FOLDER`.

Each language, each size, one PNG per screen and per state; `--language` and `--size` choose.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from tests.browser.conftest import CHROMIUM, free_port
from tests.browser.looks import SIZES
from tests.browser.stub import Stub, Stubbed
from tests.browser.stub_visits import unsent
from tests.browser.test_states import CAUSES, STOPS, TELLS, over, tell
from tests.browser.walk import tap

LANGUAGES = ["en", "en-XA", "ta", "hi", "te"]


class Camera:
    """Takes numbered photographs of one page into a folder."""

    def __init__(self, page: Page, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.page, self.folder, self._count = page, folder, 0

    def take(self, name: str, ready: str | None = None) -> None:
        """As it is now, or as soon as there is what `ready` selects; a breath later, for pictures that fade in."""
        if ready:
            self.page.wait_for_selector(ready)
            self.page.wait_for_timeout(500)
        if name not in ("person-urgent", "slip"):
            self.page.evaluate("scrollTo(0, 0)")
        self._count += 1
        self.page.screenshot(path=self.folder / f"{self._count:02d}-{name}.png")

    def tap(self, selector: str) -> None:
        tap(self.page, selector)


def photograph(page: Page, stubbed: Stubbed, folder: Path) -> None:
    """Walk through all screens, and hold every state still on the way."""
    stub, camera = stubbed.stub, Camera(page, folder)

    def at(place: str, mark: str, name: str) -> None:
        page.goto(f"{stubbed.url}/#/{place}")
        camera.take(name, mark)

    at("", "#new", "home-empty")
    visit = stub.visits.begin(consent="agreed", sex="woman", age=54, complaints=["flashes"], diabetes="yes")
    at("find", ".people", "find")
    for digit in "142":
        page.locator(f"[data-key='{digit}']").tap()
    camera.take("find-match", "#start:not([hidden])")
    page.locator("[data-key='9']").tap()
    page.locator(".people").wait_for(state="detached")
    camera.take("find-nobody", "#start:not([hidden])")
    at(f"visit/{visit['id']}/person", ".person", "person")
    page.locator("[data-field=complaints] [data-value=pain]").tap()
    page.locator(".urgent").scroll_into_view_if_needed()
    camera.take("person-urgent")
    page.locator("[data-field=complaints] [data-value=pain]").tap()
    at(f"visit/{visit['id']}/aim/R-centre", "eye-live[data-frame]", "aim")
    states(camera, stubbed)
    camera.tap("#could-not")
    camera.take("why", ".reasons")
    camera.tap("#not-asked")
    shots(camera, stub, visit)
    after(camera, stubbed, visit, at)


def states(camera: Camera, stubbed: Stubbed) -> None:
    """Every stop, every chip, every hint of aiming, the menu and what can be said aloud."""
    page, stub = camera.page, stubbed.stub
    for code in [*STOPS, *TELLS]:
        tell(stubbed, page, code)
        camera.take(code)
        over(stubbed, page, code)
    for hint in ("noeye", "closer", "left", "still"):
        stub.aim = {"code": hint, "fill": 0.5}
        page.locator(".prompt [data-icon], .prompt svg").first.wait_for()
        page.wait_for_timeout(1200)
        camera.take(f"aim-{hint}")
    stub.aim = {"code": "ready", "fill": 0.9}
    camera.tap("#open-menu")
    camera.take("menu", "dialog[open]")
    page.keyboard.press("Escape")


def shots(camera: Camera, stub: Stub, visit: dict[str, Any]) -> None:
    """Making, told, every cause, not clear after many tries, and good."""
    page, slot = camera.page, visit["slots"]["R-centre"]
    stub.hold = "verdict"
    for cause in [*CAUSES, "poor"]:
        slot["tries"] = 2 if cause == "poor" else 0
        stub.verdicts = ["shot.moved" if cause == "poor" else f"shot.{cause}"]
        camera.tap("#shutter")
        if stub.hold:
            camera.take("making", ".stage[data-mark=quick]")
            stub.hold = "keep"
            camera.take("told", "[data-phase=told]")
            stub.hold = None
        camera.take(f"shot-{cause}", "[data-phase=kept] .stage[data-mark=final]")
        camera.tap("#again")
    slot["tries"] = 0
    camera.tap("#shutter")
    camera.take("good", "[data-phase=kept] [data-verdict=good] #result-title")
    camera.tap("#open-details")
    camera.take("details", "#details[open]")
    page.keyboard.press("Escape")


def after(camera: Camera, stubbed: Stubbed, visit: dict[str, Any], at: Callable[[str, str, str], None]) -> None:
    """The rest of the visit, its end, and how it is looked at later."""
    page, stub = camera.page, stubbed.stub
    for hold in (None, "keep"):
        camera.tap("#next")
        stub.hold = hold
        camera.tap("#shutter")
        page.wait_for_selector("[data-phase=told]" if hold else "[data-phase=kept] .stage[data-mark=final]")
    camera.tap("#finish")
    camera.take("finishing", "#finishing progress")
    stub.hold = None
    camera.take("outcome", "#done")
    camera.tap("#code")
    camera.take("outcome-code", ".outcome > figure.code")
    page.emulate_media(media="print")
    camera.take("slip")
    page.emulate_media(media="screen")
    stub.sending = True
    stub.unsent = [unsent(visit, code, 3) for code in ("send.refused", "send.link")] + [unsent(visit)]
    at("", "#send", "home-sending")
    at("send", ".send .people li", "send")
    at(f"visit/{visit['id']}/outcome", "#by-itself", "outcome-sending")
    stub.sending = False
    declined = stub.visits.begin(consent="declined")
    at(f"visit/{declined['id']}/person", ".person", "declined")
    camera.tap("#finish")
    camera.take("outcome-refer", ".outcome")
    stub.visits.begin(consent="agreed", sex="man", age=61)
    at("", "#continue", "home")
    at("history", ".history [data-visit]", "history")
    at(f"visit/{visit['id']}/film", ".film li", "film")
    for pick in page.locator(".pick").all()[:2]:
        pick.tap()
    camera.tap("#copy")
    camera.take("film-picked", "[data-folder]")
    camera.tap("#compare")
    camera.take("compare", ".two figure:last-child [data-mark=final]")
    page.locator("[data-value=true]").tap()
    camera.take("compare-over", "#swap")


def main() -> None:
    """Photograph what was asked for."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("folder", type=Path)
    words.add_argument("--language", choices=LANGUAGES, action="append")
    words.add_argument("--size", choices=sorted(SIZES), action="append")
    asked = words.parse_args()
    with Stubbed(Stub(), free_port()) as stubbed, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for language in asked.language or LANGUAGES:
            for size in asked.size or SIZES:
                stubbed.stub.reset()
                width, height = SIZES[size]
                viewport = {"width": width, "height": height}
                context = browser.new_context(viewport=viewport, has_touch=True, is_mobile=True)  # type: ignore[arg-type]
                context.add_init_script(f"localStorage.setItem('diffuscope.language', '{language}')")
                photograph(context.new_page(), stubbed, asked.folder / language / size)
                context.close()


if __name__ == "__main__":
    main()
