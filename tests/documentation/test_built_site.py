"""The documentation in out/site, as built by `make site`: links, resources, search, gallery, reference."""

import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import diffuscope
import pytest
import typer
from playwright.sync_api import Browser, Request, sync_playwright

from services.cli import app
from tests.golden.command_line import subcommands
from tests.project_files import ROOT, files

pytestmark = pytest.mark.site

SITE = ROOT / "out" / "site"
SCRIPTS = sorted(Path(name).stem for name in files() if re.fullmatch(r"services/research/site/gallery/\w+\.py", name))


class Page(HTMLParser):
    """Identifiers, links, resources and pictures of one page."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: set[str] = set()
        self.resources: set[str] = set()
        self.feed(source)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Sort the attributes of one element."""
        values = {name: value for name, value in attributes if value is not None}
        self.ids |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.add(values["href"])
        elif tag == "link" and values.get("rel") not in ("canonical",):
            self.resources.add(values["href"])
        if "src" in values:
            self.resources.add(values["src"])
        self.resources |= {one.split()[0] for one in values.get("srcset", "").split(",") if one.strip()}


@cache
def page(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def pages() -> list[Path]:
    return sorted(path for path in SITE.rglob("*.html") if "_static" not in path.parts)


def is_local(address: str) -> bool:
    return not (urlsplit(address).scheme or urlsplit(address).netloc)


def broken(path: Path) -> Iterator[str]:
    """Yield the local links and resources of a page whose file or fragment does not exist."""
    for address in sorted(page(path).links | page(path).resources):
        parts = urlsplit(address)
        if is_local(address):
            target = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            fragment = unquote(parts.fragment) if target.suffix == ".html" else ""
            if not target.is_file() or (fragment and fragment not in page(target).ids):
                yield address


def test_every_link_between_pages_leads_somewhere() -> None:
    assert len(pages()) > 20
    assert not [f"{path.relative_to(SITE)}: {address}" for path in pages() for address in broken(path)]


def test_nothing_is_loaded_from_another_host() -> None:
    """Scripts, styles, fonts and pictures are files of the site."""
    foreign = [f"{path.name}: {one}" for path in pages() for one in page(path).resources if not is_local(one)]
    styles = [
        f"{path.name}: {one}"
        for path in SITE.rglob("*.css")
        for one in re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//[^)\"']+", path.read_text(encoding="utf-8"))
    ]
    assert not foreign + styles


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path="/usr/bin/chromium-headless-shell")
        yield chromium
        chromium.close()


def test_the_search_works_without_a_network(browser: Browser) -> None:
    """The pages are opened as files; the search finds the name of an argument, and asks no host."""
    asked: list[str] = []

    def note(request: Request) -> None:
        asked.append(request.url)

    opened = browser.new_page()
    opened.on("request", note)
    opened.goto(f"{(SITE / 'search.html').as_uri()}?q=reconstruct")
    opened.locator("#search-results ul.search li").first.wait_for()
    assert "python_api.html" in opened.locator("#search-results").inner_html()
    assert all(url.startswith(("file:", "data:")) for url in asked), asked


def test_no_page_scrolls_sideways(browser: Browser) -> None:
    opened = browser.new_page()
    wide = []
    for path in (path for path in pages() if "decisions" not in path.parts):
        opened.goto(path.as_uri())
        for width in (1280, 800, 390):
            opened.set_viewport_size({"width": width, "height": 800})
            if opened.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth"):
                wide.append(f"{path.relative_to(SITE)} at {width}")
    opened.close()
    assert not wide


def test_every_script_of_the_gallery_has_pictures_and_a_notebook() -> None:
    assert len(SCRIPTS) == 8
    for name in SCRIPTS:
        pictures = [one for one in page(SITE / "gallery" / f"{name}.html").resources if "_images/sphx_glr_" in one]
        assert pictures, f"{name} draws nothing"
        assert list(SITE.glob(f"_downloads/*/{name}.ipynb")), f"{name} has no notebook"
        assert list(SITE.glob(f"_downloads/*/{name}.py")), f"{name} cannot be downloaded"


def test_the_reference_has_every_public_name_and_every_command() -> None:
    described = page(SITE / "python_api.html").ids
    assert {f"diffuscope.{name}" for name in diffuscope.__all__ if not name.startswith("__")} <= described
    commands = {name for name, _ in subcommands(typer.main.get_group(app))}
    assert {f"diffuscope-{command}" for command in commands} <= page(SITE / "command_line.html").ids
