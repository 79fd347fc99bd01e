"""Latency, responsiveness and memory of the page: from tap to quick look, and during a refinement.

A real Chromium runs on the real server with the simulated head, both on the cores of this computer. Hooks on the page's
requests, events and canvases take the times. A tablet has its own cores, so the server runs with lower priority
(`nice`). Alone: `make bench-page`; MINUTES=60 aims for an hour. The exposure is that of the simulated head, which
computes for part of it, and is subtracted as reported.
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


def reload(page: Page, url: str) -> None:
    """Load the page again and aim at the next patient."""
    page.goto("about:blank")
    page.goto(aiming_at(url.split("/#")[0]))
    page.wait_for_selector("eye-live[data-frame]")


def marks(page: Page) -> list[Mark]:
    """Return the marks recorded since the last call."""
    return [(name, at_ms, more[0] if more else None) for name, at_ms, *more in page.evaluate("marks.splice(0)")]


def first(noted: list[Mark], name: str) -> float:
    """Return the time of the first mark with that name, in ms of the page's clock."""
    return next(at_ms for mark_name, at_ms, _ in noted if mark_name == name)


def pressed(page: Page) -> list[Mark] | None:
    """Return all marks from one press to its saved picture; None if the guard required a pause first."""
    page.wait_for_timeout(600)
    page.locator("#shutter[aria-disabled=false]").wait_for(timeout=60_000)
    marks(page)
    page.locator("#shutter").tap()
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final], [data-screen=aim] [data-do]", timeout=60_000)
    page.wait_for_timeout(100)
    return marks(page) if page.locator("[data-phase=kept]").count() else None


def without_a_step_ms(noted: list[Mark]) -> float:
    """Return the longest time without a visible change, from quick look to picture."""
    begin = first(noted, "shown quick")
    seen = [at for name, at, _ in noted if name in ("progress", "shown quick", "shown final") and at >= begin]
    return float(np.diff(sorted(seen)).max())


PARTS = ("tap", "post", "expose", "quick", "fetched", "shown quick")
NAMES = {
    "tap": "  tap to request",
    "post": "  request to exposure",
    "expose": "  frames to quick look, without exposure",
    "quick": "  word of it to its bytes",
    "fetched": "  bytes to screen",
}


def quick_looks(browser: Browser, url: str) -> None:
    """Print the time from tap to visible quick look, and the responsiveness of the page after it."""
    page, whole, parts, gaps, lasted = opened(browser, url), [], [], [], []
    for _ in range(3 * PRESSES):
        if len(whole) == PRESSES:
            break
        if (noted := pressed(page)) is None:
            page.wait_for_timeout(3000)
            reload(page, url)
            continue
        exposed_ms = 1000 * next(more for name, _, more in noted if name == "kept")["expose"]
        times = [first(noted, name) for name in PARTS]
        taken = np.diff(times) - np.array([0, 0, exposed_ms, 0, 0])
        parts.append(taken)
        whole.append(float(taken.sum()))
        gaps.append(without_a_step_ms(noted))
        lasted.append(first(noted, "kept") - times[-1])
        reload(page, url)
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
    """Print the responsiveness of a page that waits for the picture of a large sensor."""
    page, gaps, lasted = opened(browser, url), [], []
    for _ in range(rounds):
        if (noted := pressed(page)) is None:
            page.wait_for_timeout(3000)
        else:
            gaps.append(without_a_step_ms(noted))
            lasted.append(first(noted, "shown final") - first(noted, "shown quick"))
        reload(page, url)
    head(f"waiting for the picture of a large sensor, {len(gaps)} times, s", "p50", "p95", "worst", "limit")
    show("longest time without a step of progress", gaps, 1.0)
    show("  quick look to picture", lasted)
    page.context.close()


def going_on(browser: Browser, url: str, rounds: int = 8) -> None:
    """Print the responsiveness of a page that continues with the next picture during the refinement of the last one."""
    page, answers, gaps, frames, lasted = opened(browser, url), [], [], [], []
    for _ in range(rounds):
        page.wait_for_timeout(600)
        page.locator("#shutter[aria-disabled=false]").wait_for(timeout=60_000)
        page.locator("#shutter").tap()
        page.wait_for_selector("[data-phase=assessed] #next, [data-phase=kept] #next, [data-screen=aim] [data-do]")
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
        reload(page, url)
    head(f"going on while it is refined, {len(gaps)} times, s", "p50", "p95", "worst", "limit")
    show("tap to the next screen", answers, 0.1)
    show("longest time without a live picture", gaps, 1.0)
    show("  how long the picture was still made", lasted)
    row("  live pictures meanwhile, number", *(float(np.percentile(frames, q)) for q in (50, 5, 0)))
    page.context.close()


def a_long_one(folder: Path) -> Path:
    """Return a recording with a reconstruction of seconds: unknown field, edges extended to a large sensor."""
    scene = ROOT / "device" / "sim" / "scenes" / "diabetic.toml"
    sh(str(Path(sys.executable).parent / "diffuscope"), "simulate", str(scene), "-o", str(folder / "scene"))
    wide = folder / "wide"
    wide.mkdir()
    for name in ("raw.tiff", "psf.tiff"):
        counts = tifffile.imread(folder / "scene" / name)
        tifffile.imwrite(wide / name, np.pad(counts, ((540, 540), (960, 960)), "edge"))
    return wide


def ready(server: Server) -> None:
    """Wait until the server has measured this computer and made its FFT plans."""
    server.wait_until_ready()
    while json.load(urllib.request.urlopen(f"{server.url}/api/status", timeout=30))["state"] != "aim":
        time.sleep(0.5)


@contextmanager
def serving(folder: Path, *source: str) -> Iterator[str]:
    """Yield the address of the aiming screen on a new server."""
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
    """Run all measurements."""
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
