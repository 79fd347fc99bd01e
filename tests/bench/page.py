"""The page beside the instrument: from tap to quick look, how alive it is while a picture is refined, its memory.

A real Chromium on the real server with the simulated head, both on the cores of this computer. What the page draws is
timed in the page itself, by hooks on its requests, events and canvases. A tablet has cores of its own: so the server
gives way to the browser (`nice`). By itself: `make bench-page`; MINUTES=60 aims for an hour. The exposure is that of
the simulated head, which computes for part of it, and is taken off as reported.
"""

import json
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from playwright.sync_api import Browser, Page, sync_playwright

from tests.bench.soak import memory
from tests.bench.timing import head, row
from tests.bench.wifi import aiming_at, sh
from tests.browser.conftest import CHROMIUM, ROOT, Server

PRESSES = 30
MINUTES = 10.0
HOOKS = """
window.marks = [];
const mark = (name, more) => window.marks.push([name, performance.now(), more]);
addEventListener("pointerup", ({ target, timeStamp }) => {
  if (target.closest("button")) window.marks.push(["tap", timeStamp]);
}, true);
const painted = (name, more) => requestAnimationFrame(() => {
  const { port1, port2 } = new MessageChannel();
  port1.onmessage = () => mark(name, more);
  port2.postMessage(null);
});
addEventListener("drawn", ({ detail }) => painted(`shown ${detail.mark}`), true);
const fetched = window.fetch;
window.fetch = async (path, options) => {
  if (options?.method === "POST" && path === "/api/captures") mark("post");
  const answer = await fetched(path, options);
  if (String(path).endsWith("quick.jpg")) mark("fetched");
  return answer;
};
const Line = window.EventSource;
window.EventSource = class extends Line {
  constructor(...words) {
    super(...words);
    this.addEventListener("stage", ({ data }) => mark(JSON.parse(data).stage));
    this.addEventListener("kept", ({ data }) => mark("kept", JSON.parse(data).report.seconds));
  }
};
const observed = new MutationObserver((changes) => {
  for (const { target } of changes) {
    if (target.localName === "eye-live") painted("live");
    else if (target.matches?.(".page")) painted(`screen ${target.dataset.screen}`);
  }
});
observed.observe(document, { subtree: true, attributes: true, attributeFilter: ["data-frame", "data-screen"] });
const valued = Object.getOwnPropertyDescriptor(HTMLProgressElement.prototype, "value");
Object.defineProperty(HTMLProgressElement.prototype, "value", { ...valued, set(value) {
  if (value !== this.value) painted("progress");
  valued.set.call(this, value);
} });
"""
Mark = tuple[str, float, Any]


def opened(browser: Browser, url: str) -> Page:
    page = browser.new_context(viewport={"width": 1280, "height": 800}, has_touch=True).new_page()
    page.add_init_script(HOOKS)
    page.goto(url)
    page.wait_for_selector("eye-live[data-frame]", timeout=60_000)
    return page


def anew(page: Page, url: str) -> None:
    """Aim at the next person, as if just loaded."""
    page.goto("about:blank")
    page.goto(aiming_at(url.split("/#")[0]))
    page.wait_for_selector("eye-live[data-frame]")


def marks(page: Page) -> list[Mark]:
    """What was noted since it was asked for last."""
    return [(name, at_ms, more[0] if more else None) for name, at_ms, *more in page.evaluate("marks.splice(0)")]


def first(noted: list[Mark], name: str) -> float:
    """When it was noted, in ms of the page's clock."""
    return next(at_ms for one, at_ms, _ in noted if one == name)


def pressed(page: Page) -> list[Mark] | None:
    """All that is noted from one press to its kept picture; None where the guard wanted darkness first."""
    page.wait_for_timeout(600)
    page.locator("#shutter[aria-disabled=false]").wait_for(timeout=60_000)
    marks(page)
    page.locator("#shutter").tap()
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final], [data-screen=aim] [data-do]", timeout=60_000)
    page.wait_for_timeout(100)
    return marks(page) if page.locator("[data-phase=kept]").count() else None


def without_a_step_ms(noted: list[Mark]) -> float:
    """The longest time, from the quick look to the picture, in which nothing moved on the page."""
    begin = first(noted, "shown quick")
    seen = [at for name, at, _ in noted if name in ("progress", "shown quick", "shown final") and at >= begin]
    return float(np.diff(sorted(seen)).max())


PARTS = ("tap", "post", "expose", "quick", "fetched", "shown quick")
NAMES = {
    "tap": "  tap to request", "post": "  request to exposure", "expose": "  frames to quick look, without exposure",
    "quick": "  word of it to its bytes", "fetched": "  bytes to screen",
}  # fmt: skip


def quick_looks(browser: Browser, url: str) -> None:
    """Print the way from the tap to the quick look on the screen, and how alive the page is after it."""
    page, whole, parts, gaps, lasted = opened(browser, url), [], [], [], []
    for _ in range(3 * PRESSES):
        if len(whole) == PRESSES:
            break
        if (noted := pressed(page)) is None:
            page.wait_for_timeout(3000)
            anew(page, url)
            continue
        exposed_ms = 1000 * next(more for name, _, more in noted if name == "kept")["expose"]
        times = [first(noted, name) for name in PARTS]
        taken = np.diff(times) - np.array([0, 0, exposed_ms, 0, 0])
        parts.append(taken)
        whole.append(float(taken.sum()))
        gaps.append(without_a_step_ms(noted))
        lasted.append(first(noted, "kept") - times[-1])
        anew(page, url)
    head(f"press to quick look, {len(whole)} presses, s", "p50", "p95", "worst", "limit")
    show("tap to quick look on the screen, without exposure", whole, 0.35)
    for name, column in zip(PARTS, np.array(parts).T, strict=False):
        show(NAMES[name], list(column))
    show("after it: longest time without a step of progress", gaps, 1.0)
    show("  how long the picture was made meanwhile", lasted)
    page.context.close()


def show(name: str, times_ms: list[float], limit_s: float | None = None) -> None:
    p50, p95, worst = (float(np.percentile(times_ms, q)) / 1000 for q in (50, 95, 100))
    row(name, p50, p95, worst, limit=limit_s, value=p95)


def staying(browser: Browser, url: str, rounds: int = 8) -> None:
    """Print how alive a page is that waits for the picture of a large sensor."""
    page, gaps, lasted = opened(browser, url), [], []
    for _ in range(rounds):
        if (noted := pressed(page)) is None:
            page.wait_for_timeout(3000)
        else:
            gaps.append(without_a_step_ms(noted))
            lasted.append(first(noted, "shown final") - first(noted, "shown quick"))
        anew(page, url)
    head(f"waiting for the picture of a large sensor, {len(gaps)} times, s", "p50", "p95", "worst", "limit")
    show("longest time without a step of progress", gaps, 1.0)
    show("  quick look to picture", lasted)
    page.context.close()


def going_on(browser: Browser, url: str, rounds: int = 8) -> None:
    """Print how a page fares that goes on to the next picture while the last one is still refined."""
    page, answers, gaps, frames, lasted = opened(browser, url), [], [], [], []
    for _ in range(rounds):
        page.wait_for_timeout(600)
        page.locator("#shutter[aria-disabled=false]").wait_for(timeout=60_000)
        page.locator("#shutter").tap()
        page.wait_for_selector("[data-phase=told] #next, [data-phase=kept] #next, [data-screen=aim] [data-do]")
        if page.locator("#next").count() == 0:
            page.wait_for_timeout(3000)
        else:
            page.wait_for_timeout(500)
            marks(page)
            page.locator("#next").tap()
            page.wait_for_function("() => marks.some(([name]) => name === 'kept')", timeout=60_000)
            noted = marks(page)
            tapped = first(noted, "tap")
            answers.append(min(at for name, at, _ in noted if name.startswith("screen") and at > tapped) - tapped)
            seen = sorted(at for name, at, _ in noted if name in ("live", "kept") and at > tapped)
            gaps.append(float(np.diff([tapped, *seen]).max()))
            lasted.append(first(noted, "kept") - tapped)
            frames.append(sum(name == "live" for name, *_ in noted))
        anew(page, url)
    head(f"going on while it is refined, {len(gaps)} times, s", "p50", "p95", "worst", "limit")
    show("tap to the next screen", answers, 0.1)
    show("longest time without a live picture", gaps, 1.0)
    show("  how long the picture was still made", lasted)
    row("  live pictures meanwhile, number", *(float(np.percentile(frames, q)) for q in (50, 5, 0)))
    page.context.close()


def a_long_one(folder: Path) -> Path:
    """A recording that takes seconds to make: its field is not known, its edges are drawn out to a large sensor."""
    scene = ROOT / "device" / "sim" / "scenes" / "diabetic.toml"
    sh(str(Path(sys.executable).parent / "diffuscope"), "simulate", str(scene), "-o", str(folder / "scene"))
    wide = folder / "wide"
    wide.mkdir()
    for name in ("raw.tiff", "psf.tiff"):
        counts = tifffile.imread(folder / "scene" / name)
        tifffile.imwrite(wide / name, np.pad(counts, ((540, 540), (960, 960)), "edge"))
    return wide


def ready(server: Server) -> None:
    """Wait until it has measured this computer and made its plans."""
    server.wait_until_ready()
    while json.load(urllib.request.urlopen(f"{server.url}/api/status", timeout=30))["state"] != "aim":
        time.sleep(0.5)


@contextmanager
def serving(folder: Path, *source: str) -> Iterator[str]:
    """The address at which somebody aims, on a server of its own."""
    folder.mkdir()
    server = Server(folder / "data", *source)
    server.before = ["nice", "-n", "5"]
    server.start()
    try:
        ready(server)
        yield aiming_at(server.url)
    finally:
        server.close()


def main() -> None:
    """Measure all of it."""
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        with serving(Path(place) / "ours") as url:
            quick_looks(browser, url)
        with serving(Path(place) / "long", str(a_long_one(Path(place))), "--replay") as url:
            staying(browser, url)
            going_on(browser, url)
        browser.close()
        with serving(Path(place) / "hour") as url:
            memory(url, minutes)


if __name__ == "__main__":
    main()
