"""Latency of a tool of the picture viewer, with the graphics chip and without.

A real Chromium shows one picture of 1024 x 1024 in the page's element on 1280 x 800. A tool is changed, and the timer
stops when a pixel of the canvas has been read back, so each figure includes a wait of up to one frame (17 ms). A
software chip (SwiftShader, where the benchmark's computer has no chip) adds its computation: an ordinary browser
refuses such a chip, so its figures are the worst case. `CPU/4` slows the page's thread four times, as an estimate of a
cheap tablet. Limits: 50 ms with the chip, 100 ms without.
"""

import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from tests.bench.timing import head, row
from tests.browser.conftest import CHROMIUM
from tests.browser.real import Real

LIMITS_MS = {"gl": 50.0, "2d": 100.0}
FLAGS = {"gl": [], "2d": ["--use-gl=disabled"]}
SIDE, ROUNDS = 1024, 40

SHOWN = """async (side) => {
  await import(new URL("components/viewer/viewer.js", document.querySelector("script[type=module]").src).href);
  const drawing = Object.assign(document.createElement("canvas"), { width: side, height: side });
  const context = drawing.getContext("2d");
  const pixels = context.createImageData(side, side);
  for (let i = 0; i < pixels.data.length; i += 1) pixels.data[i] = i % 4 === 3 ? 255 : (i * 2654435761) >>> 24;
  context.putImageData(pixels, 0, 0);
  const blob = await new Promise((done) => drawing.toBlob(done));
  const pic = document.createElement("eye-pic");
  document.body.replaceChildren(pic);
  const drawn = new Promise((done) => pic.addEventListener("drawn", done));
  pic.src = { blob, mark: "final" };
  await drawn;
  await new Promise((done) => setTimeout(done, 500));
  return pic.dataset.painter;
}"""

CHANGED = """async (rounds) => {
  const pic = document.querySelector("eye-pic");
  const frame = () => new Promise(requestAnimationFrame);
  const glass = pic.querySelector("canvas").getContext("2d", { alpha: false });
  const [all, drawing] = [[], []];
  for (let i = 0; i < rounds; i += 1) {
    await frame();
    const began = performance.now();
    const painted = frame().then(() => performance.now());
    pic.redfree = i % 2 === 0;
    pic.contrast = (i % 5) + 1;
    await frame();
    glass.getImageData(5, 5, 1, 1);
    const ended = performance.now();
    all.push(ended - began);
    drawing.push(ended - (await painted));
  }
  return [all, drawing];
}"""


@contextmanager
def showing(browser: Browser, url: str, slower: int) -> Iterator[tuple[Page, str]]:
    """Yield a page with one picture, on a processor slowed by `slower`, and the renderer in use."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, has_touch=True)
    page = context.new_page()
    page.goto(url)
    page.wait_for_selector("#new")
    painter: str = page.evaluate(SHOWN, SIDE)
    page.context.new_cdp_session(page).send("Emulation.setCPUThrottlingRate", {"rate": slower})
    yield page, painter
    context.close()


def viewer() -> None:
    """Print the time of a tool change for both renderers, and their ratio."""
    title = f"a tool change on {SIDE} x {SIDE}, until it is seen, ms"
    head(title, "first", "median", "p95", "drawing", "of limit", "limit")
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Real(Path(folder), Path(folder) / "plans")) as real,
        sync_playwright() as playwright,
    ):
        real.wait_until_ready()
        for slower in (1, 4):
            medians = {}
            for wanted, flags in FLAGS.items():
                browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *flags])
                with showing(browser, real.url, slower) as (page, painter):
                    assert painter == wanted, f"this Chromium draws by {painter}"
                    times, drawing = page.evaluate(CHANGED, ROUNDS)
                first, later = times[0], sorted(times[1:])
                median, p95 = later[len(later) // 2], later[int(0.95 * len(later))]
                medians[wanted] = median
                limit = LIMITS_MS[wanted]
                name = f"{wanted}, CPU/{slower}"
                only = sorted(drawing[1:])[len(later) // 2]
                row(name, first, median, p95, only, p95 / limit, limit=limit, value=p95)
                browser.close()
            row(f"gl over 2d, CPU/{slower}", None, medians["gl"] / medians["2d"])
