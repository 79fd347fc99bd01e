"""README's two pictures of the page, from the real server with the simulated head: `make page-pictures`.

The labels of the screens are recorded beside the pictures, and a test compares them with the labels of the page.
"""

import json
import re
import shutil
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from playwright.sync_api import Page, ViewportSize, sync_playwright

from tests.browser.conftest import CHROMIUM, PLANS, TABLET, Server
from tests.browser.walk import new_person, take_picture

FOLDER = Path(__file__).parents[2] / "hardware" / "pictures"
LABELS = FOLDER / "page-labels.json"
FADE_MS = 1000


def labels(page: Page) -> list[str]:
    """Return the texts of the visible headings and buttons of a page, with # in place of each number of a patient."""
    texts = page.locator("h1:visible, h2:visible, button:visible").all_inner_texts()
    return [re.sub(r"[A-Z]{6}[\d-]+", "#", " ".join(text.split())) for text in texts if text.strip()]


def photograph(page: Page, name: str) -> list[str]:
    """Save a screenshot with 256 colours as `name`.png, and return its labels."""
    page.wait_for_timeout(FADE_MS)
    picture = FOLDER / f"{name}.png"
    page.screenshot(path=picture)
    Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)
    return labels(page)


def main() -> None:
    """Go from the home screen to the first picture, and save the two screens with their labels."""
    width, height = TABLET
    with (
        TemporaryDirectory() as scratch,
        closing(Server(Path(scratch) / "data")) as server,
        sync_playwright() as playwright,
    ):
        if PLANS.is_dir():
            shutil.copytree(PLANS, server.data / "plans")
        server.start()
        server.wait_until_ready()
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        viewport = ViewportSize(width=width, height=height)
        page = browser.new_context(viewport=viewport, has_touch=True, is_mobile=True).new_page()
        page.goto(server.url)
        page.locator(".state[data-state=aim]").wait_for(state="attached", timeout=300_000)
        new_person(page)
        shown = {"aim": photograph(page, "aim")}
        take_picture(page)
        shown["result"] = photograph(page, "result")
        browser.close()
    LABELS.write_text(json.dumps(shown, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
