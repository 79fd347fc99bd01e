"""Memory growth of the page per hour of aiming, in a Chromium without an attached debugger.

Playwright listens to the network of every page it opens, and the page's process keeps records for it: these alone grew
by 30 MB an hour. Here commands go through a pipe, and a debugger is attached only during each command. The memory of a
renderer is its private dirty memory as counted by the kernel, after garbage collection.
"""

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.bench.timing import head, row
from tests.browser.conftest import CHROMIUM

EVERY_S, LOOKS = 10.0, 30  # sampling interval, and minimum number of samples
WARM_H = 1 / 60  # warm-up: fonts, code and caches are loaded once
WORDS = ("--headless", "--no-sandbox", "--window-size=1280,800", "--remote-debugging-pipe")
PIPED = 'exec "$0" "$@" 3<&{} 4>&{}'  # file descriptors of Chromium's commands and answers


class PipedBrowser:
    """A Chromium with one page, controlled through a pipe; no debugger is attached between two commands."""

    def __init__(self, folder: Path, url: str) -> None:
        reads, self._commands = os.pipe()
        self._answers, writes = os.pipe()
        words = (CHROMIUM, *WORDS, f"--user-data-dir={folder}", "about:blank")
        piped = ["bash", "-c", PIPED.format(reads, writes), *words]
        self._process = subprocess.Popen(piped, pass_fds=(reads, writes), stderr=subprocess.DEVNULL)
        os.close(reads)
        os.close(writes)
        self._heard, self._number = b"", 0
        self.ask("Page.navigate", url=url)

    def ask(self, method: str, **words: Any) -> dict[str, Any]:
        """Attach to the page, send one command, detach, and return its answer."""
        page = next(target for target in self._pages() if target["type"] == "page")
        session = self._say("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        answer = self._say(method, session, **words)
        self._say("Target.detachFromTarget", sessionId=session)
        return answer

    def value(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        return self.ask("Runtime.evaluate", expression=expression)["result"].get("value")

    def own_mb(self) -> float:
        """Return the private dirty memory of the renderer processes."""
        processes = self._say("SystemInfo.getProcessInfo")["processInfo"]
        sizes = [
            Path(f"/proc/{process['id']}/smaps_rollup").read_text()
            for process in processes
            if process["type"] == "renderer"
        ]
        return (
            sum(int(line.split()[1]) for text in sizes for line in text.splitlines() if "Private_Dirty" in line) / 1024
        )

    def close(self) -> None:
        """End the browser."""
        self._process.terminate()
        self._process.wait(10)
        os.close(self._commands)
        os.close(self._answers)

    def _pages(self) -> list[dict[str, Any]]:
        while not (found := self._say("Target.getTargets")["targetInfos"]):
            time.sleep(0.1)  # no target exists right after the start
        targets: list[dict[str, Any]] = found
        return targets

    def _say(self, method: str, session: str | None = None, **words: Any) -> dict[str, Any]:
        self._number += 1
        command = {"id": self._number, "method": method, "params": words} | ({"sessionId": session} if session else {})
        os.write(self._commands, json.dumps(command).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            pass  # an event, which is ignored
        assert "result" in answer, answer
        result: dict[str, Any] = answer["result"]
        return result

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._heard:
            more = os.read(self._answers, 1 << 16)
            assert more, "the browser ended"
            self._heard += more
        encoded, self._heard = self._heard.split(b"\0", 1)
        message: dict[str, Any] = json.loads(encoded)
        return message


class Seen(NamedTuple):
    """One sample: time, heap of the page's code, and private memory of its process."""

    at_h: float
    heap_mb: float
    own_mb: float


def memory(url: str, minutes: float) -> None:
    """Print the memory curve, its slope in the second half, and the extrapolation to one hour."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        closing(PipedBrowser(Path(folder), url)) as browser,
    ):
        while not browser.value("document.querySelector('eye-live[data-frame]') !== null"):
            time.sleep(0.5)
        seen = np.array(list(watched(browser, minutes)))
        number = browser.value("document.querySelector('eye-live').dataset.frame")
    at_h, *kinds = seen.T
    warm = at_h >= min(WARM_H, at_h[-1] / 2)
    columns = ("1st min", "then", "mid", "end", "rise/h", "sd", "in 1 h", "limit")
    head(f"memory, {minutes:.0f} min of aiming, MB ({number} live pictures)", *columns)
    for name, mb in zip(("heap of the page's code", "its process, all that is its own"), kinds, strict=True):
        print_row(f"{name}, extrapolated", at_h[warm], mb[warm], float(mb[0]))
    print("rise/h: by a straight line through the second half; in 1 h: what was seen, and that rise for the rest")
    parts = np.array_split(np.array(kinds[1]), min(len(at_h), 10))
    print("its process, means of ten equal parts of the time: " + " ".join(f"{part.mean():.1f}" for part in parts))


def watched(browser: PipedBrowser, minutes: float) -> Iterator[Seen]:
    """Yield a sample every ten seconds, or oftener in a short run, after garbage collection."""
    begin_s = time.monotonic()
    for at_s in np.arange(0.0, 60 * minutes + 1, min(EVERY_S, 60 * minutes / LOOKS)):
        time.sleep(max(0.0, begin_s + at_s - time.monotonic()))
        browser.ask("HeapProfiler.collectGarbage")
        heap_mb = browser.ask("Runtime.getHeapUsage")["usedSize"] / 2**20
        yield Seen((time.monotonic() - begin_s) / 3600, heap_mb, browser.own_mb())


def print_row(name: str, at_h: NDArray[np.float64], mb: NDArray[np.float64], first_mb: float) -> None:
    """Print one row: the curve, its slope in the second half, and the extrapolated increase after an hour."""
    late = at_h >= (at_h[0] + at_h[-1]) / 2
    (rise, _), spread = np.polyfit(at_h[late], mb[late], 1, cov=True)
    few = max(1, len(mb) // 10)
    begin, mid, end = (float(np.median(part)) for part in (mb[:few], mb[late][:few], mb[-few:]))
    in_1_h = end - begin + float(rise) * max(0.0, 1.0 - (at_h[-1] - at_h[0]))
    row(name, first_mb, begin, mid, end, float(rise), float(np.sqrt(spread[0, 0])), in_1_h, limit=10.0, value=in_1_h)
