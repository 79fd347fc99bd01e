"""A tablet on a bad link: age of the live picture, detection of a lost link, and time to first use.

The tablet is a real Chromium in a network namespace, behind a queue of limited rate; the server is `diffuscope run`.
Needs root. A relay between the two records the departure of each live picture, and the browser its drawing, on one
clock. Alone: `make bench-wifi`.
"""

import asyncio
import json
import re
import secrets
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

from tests.bench.timing import head, row
from tests.browser.conftest import CHROMIUM, Server, free_port
from tests.network_namespace import HERE, IN_SPACE, OURS, THEIRS, namespace, sh

WATCHED_S = 20.0
FIRST_USES = 9
LOADED = "performance.getEntriesByType('resource').map(({ startTime, transferSize }) => [startTime, transferSize])"
AGED = re.compile(rb"x-frame: (\d+)\r\nx-age-ms: (\d+)", re.IGNORECASE)
DRAWN = """
window.drawn = [];
const fetched = window.fetch;
let latest = 0;
window.fetch = async (...words) => {
  const answer = await fetched(...words);
  if (answer.headers.has("X-Frame")) latest = Number(answer.headers.get("X-Frame"));
  return answer;
};
const draw = CanvasRenderingContext2D.prototype.drawImage;
CanvasRenderingContext2D.prototype.drawImage = function (...words) {
  draw.apply(this, words);
  if (this.canvas.closest("eye-live")) window.drawn.push([latest, performance.timeOrigin + performance.now()]);
};
"""


def throttle(mbit_per_s: int) -> None:
    """Limit both directions by a queue of 400 ms."""
    queue = ["root", "tbf", "rate", f"{mbit_per_s}mbit", "burst", "16kb", "latency", "400ms"]
    sh("tc", "qdisc", "replace", "dev", OURS, *queue)
    sh(*IN_SPACE, "tc", "qdisc", "replace", "dev", THEIRS, *queue)


class Relay:
    """TCP relay between tablet and server; records when the light of each live picture was collected."""

    def __init__(self, server_port: int) -> None:
        self.port, self._server_port = free_port(), server_port
        self.lit_ms: dict[int, float] = {}
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        asyncio.run_coroutine_threadsafe(asyncio.start_server(self._relay, HERE, self.port), self._loop).result(5)

    async def _relay(self, tablet_in: asyncio.StreamReader, tablet_out: asyncio.StreamWriter) -> None:
        server_in, server_out = await asyncio.open_connection("127.0.0.1", self._server_port)
        await asyncio.gather(self._pass(tablet_in, server_out, False), self._pass(server_in, tablet_out, True))

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, note: bool) -> None:
        try:
            while data := await source.read(65536):
                if note and (found := AGED.search(data)):
                    self.lit_ms[int(found[1])] = time.time() * 1000 - int(found[2])
                sink.write(data)
                await sink.drain()
        except OSError:
            return
        finally:
            sink.close()


@contextmanager
def tablet(folder: Path) -> Iterator[Browser]:
    """Yield a Chromium at the other end of the link."""
    wrapper = folder / "chromium"
    wrapper.write_text(f'#!/bin/sh\nexec {" ".join(IN_SPACE)} {CHROMIUM} "$@"\n')
    wrapper.chmod(0o755)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(wrapper), args=["--no-sandbox"])
        yield browser
        browser.close()


def aiming_at(url: str) -> str:
    """Return the address of the aiming screen for a patient with consent."""

    def send(method: str, path: str, **body: str) -> dict[str, str]:
        content = json.dumps({"key": secrets.token_hex(8), **body}).encode()
        headers = {"Content-Type": "application/json"}
        asked = urllib.request.Request(f"{url}{path}", content, headers, method=method)
        answer: dict[str, str] = json.load(urllib.request.urlopen(asked, timeout=30))
        return answer

    visit = send("POST", "/api/visits")["id"]
    send("PATCH", f"/api/visits/{visit}", field="consent", value="agreed")
    return f"{url}/#/visit/{visit}/aim/R-centre"


def opened(browser: Browser, url: str, slower: int = 1) -> tuple[Page, float]:
    """Return the page at its live picture, on a processor slowed by `slower`, and the time it took."""
    page = browser.new_context(viewport={"width": 1280, "height": 800}, has_touch=True).new_page()
    page.add_init_script(DRAWN)
    page.context.new_cdp_session(page).send("Emulation.setCPUThrottlingRate", {"rate": slower})
    begin_s = time.monotonic()
    page.goto(url)
    page.wait_for_selector("eye-live[data-frame]", timeout=60_000)
    return page, time.monotonic() - begin_s


def ages(browser: Browser, relay: Relay, url: str, mbit_per_s: int, limit_ms: float | None) -> None:
    """Print the age of each live picture at its drawing, and the rate of pictures."""
    throttle(mbit_per_s)
    page, _ = opened(browser, url)
    page.wait_for_timeout(2000)
    page.evaluate("window.drawn = []")
    page.wait_for_timeout(WATCHED_S * 1000)
    first: dict[int, float] = {}
    for number, at_ms in page.evaluate("window.drawn"):
        first.setdefault(int(number), at_ms)
    aged = [at_ms - relay.lit_ms[number] for number, at_ms in first.items() if number in relay.lit_ms]
    p95 = float(np.percentile(aged, 95))
    row(
        f"live picture at {mbit_per_s} Mbit/s: age p95, ms",
        float(np.median(aged)),
        p95,
        len(first) / WATCHED_S,
        limit=limit_ms,
        value=p95,
    )
    page.context.close()


def losses(browser: Browser, url: str) -> None:
    """Print the time to detect a lost link, and to detect its return."""
    throttle(8)
    page, _ = opened(browser, url)
    message = page.get_by_text("not answering").first
    detected_s, back_s = [], []
    for _ in range(3):
        page.wait_for_timeout(1500)
        sh("ip", "link", "set", OURS, "down")
        begin_s = time.monotonic()
        message.wait_for(state="visible", timeout=20_000)
        detected_s.append(time.monotonic() - begin_s)
        sh("ip", "link", "set", OURS, "up")
        begin_s = time.monotonic()
        message.wait_for(state="hidden", timeout=20_000)
        back_s.append(time.monotonic() - begin_s)
    for name, times, limit in (("lost link told, s", detected_s, 5.0), ("its return noticed, s", back_s, 2.0)):
        row(name, float(np.median(times)), max(times), 0.0, limit=limit, value=max(times))
    page.context.close()


def first_use(browser: Browser, url: str) -> None:
    """Print the time to the live picture on a slow tablet at 8 Mbit/s, and the requests until then."""
    throttle(8)
    opened(browser, url)[0].context.close()  # leaves the preview running
    times, drawn, answers, sizes = [], [], [], []
    for _ in range(FIRST_USES):
        page, took_s = opened(browser, url, slower=6)
        times.append(took_s)
        at_ms = page.evaluate("window.drawn[0][1] - performance.timeOrigin")
        parts = page.evaluate(LOADED)
        drawn.append(at_ms / 1000)
        answers.append(1 + sum(begun_ms < at_ms for begun_ms, _ in parts))
        sizes.append(sum(size for begun_ms, size in parts if begun_ms < at_ms) / 1000)
        page.context.close()
    median = float(np.median(times))
    row("usable at 8 Mbit/s, CPU/6, s", median, max(times), 0.0, limit=1.5, value=median)
    row("  first live picture by the page's own clock, s", float(np.median(drawn)), max(drawn))
    row("  requests until then", float(np.median(answers)), float(max(answers)))
    row("  kilobytes until then", float(np.median(sizes)), max(sizes))


def main() -> None:
    """Run all measurements."""
    with tempfile.TemporaryDirectory() as place, namespace():
        server = Server(Path(place) / "data")
        server.start()
        try:
            server.wait_until_ready()
            relay = Relay(server.port)
            url = aiming_at(f"http://{HERE}:{relay.port}")
            head("a tablet at the end of a bad link", "median", "p95/worst", "per s", "limit")
            with tablet(Path(place)) as browser:
                ages(browser, relay, url, 8, None)
                ages(browser, relay, url, 2, 300.0)
                losses(browser, url)
                first_use(browser, url)
        finally:
            server.close()


if __name__ == "__main__":
    sys.exit(main())
