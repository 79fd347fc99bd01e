"""Photographs of every screen and state, for people to look at: `python -m tests.browser.photograph FOLDER`.

Each language, each size, one PNG per screen and per state; `--language` and `--size` choose.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from tests.browser.conftest import CHROMIUM, free_port
from tests.browser.looks import SIZES
from tests.browser.stub import Stub, Stubbed
from tests.browser.stub_visits import unsent
from tests.browser.test_states import CAUSES, STOPS, TELLS, over, tell

LANGUAGES = ["en", "en-XA", "ta", "hi", "te"]


def photograph(page: Page, stubbed: Stubbed, folder: Path) -> None:
    """Walk through all screens, then hold every state still."""
    stub = stubbed.stub
    folder.mkdir(parents=True, exist_ok=True)
    count = 0

    def take(name: str) -> None:
        nonlocal count
        count += 1
        page.screenshot(path=folder / f"{count:02d}-{name}.png")

    def at(place: str, mark: str) -> None:
        page.goto(f"{stubbed.url}/#/{place}")
        page.wait_for_selector(mark)
        page.wait_for_timeout(600)
        take(place.split("/")[2] if place.startswith("visit/") else place or "home")

    visit = stub.visits.begin(consent="agreed", sex="woman", age=54, complaints=["pain"], diabetes="yes")
    at("", "#new")
    at("find", ".pad")
    at(f"visit/{visit['id']}/person", ".person")
    at(f"visit/{visit['id']}/aim/R-centre", "eye-live[data-frame]")
    for code in [*STOPS, *TELLS]:
        tell(stubbed, page, code)
        take(code)
        over(stubbed, page, code)
        page.wait_for_timeout(100)
    for hint in ("noeye", "closer", "left", "still"):
        stub.aim = {"code": hint, "fill": 0.5}
        page.wait_for_timeout(900)
        take(f"aim-{hint}")
    shots(page, stub, take)
    page.wait_for_timeout(500)
    page.locator("#finish").tap()
    page.wait_for_selector("#code")
    page.wait_for_timeout(500)
    page.locator("#code").tap()
    page.wait_for_selector(".outcome > figure.code")
    take("outcome")
    page.emulate_media(media="print")
    take("slip")
    page.emulate_media(media="screen")
    stub.sending = True
    stub.unsent = [unsent(visit, code, 3) for code in ("send.refused", "send.link")] + [unsent(visit)]
    for place, mark in (("", "#send"), ("send", ".send .people li"), (f"visit/{visit['id']}/outcome", "#by-itself")):
        at(place, mark)
    at("history", ".history [data-visit]")
    at(f"visit/{visit['id']}/film", ".film li")
    ids = visit["slots"]["R-centre"]["captures"][:2]
    at(f"visit/{visit['id']}/compare/{ids[0]}/{ids[1]}", ".two [data-mark=final]")


def shots(page: Page, stub: Stub, take: Callable[[str], None]) -> None:
    """Making, told, and every cause."""
    for cause in [*CAUSES, None]:
        stub.visits.kept["v142"]["slots"]["R-centre"]["tries"] = 2 if cause is None else 0
        stub.verdicts = [f"shot.{cause}" if cause else "shot.moved"]
        stub.refine_s = 2.0 if cause == CAUSES[0] else 0.1
        page.wait_for_timeout(500)
        page.locator("#shutter").tap()
        if cause == CAUSES[0]:
            page.wait_for_selector(".stage[data-mark=quick]")
            take("making")
            page.wait_for_selector("[data-phase=told]")
            take("told")
        page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
        page.wait_for_timeout(300)
        take(f"shot-{cause or 'poor'}")
        page.wait_for_timeout(300)
        page.locator("#again").tap()
    stub.verdicts = []
    page.wait_for_timeout(500)
    page.locator("#shutter").tap()
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    take("good")


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
