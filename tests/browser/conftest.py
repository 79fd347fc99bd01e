"""Fixtures: the real application in this process or in its own, and a touch page that fails on console messages."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, expect, sync_playwright

from tests.browser.alert_causes import StandingAlerts
from tests.browser.real import Instruments, Real

ROOT = Path(__file__).parents[2]
PLANS = ROOT / "out" / "browser-plans"  # cached FFT plans and timings of this computer; deleted by `make clean`
SMALL_PLANS = PLANS.with_name("browser-plans-small")  # the same for heads with a small sensor
CHROMIUM = "/usr/bin/chromium-headless-shell"
TABLET = (1280, 800)
PATIENCE_MS = 60_000  # ends a test that waits in vain; on a busy machine all takes several times as long
expect.set_options(timeout=PATIENCE_MS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give a browser test that fails one more try; the summary names it, for it or the page has to be mended.

    A browser, a server and a solver share the cores with whatever else runs.
    """
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.flaky(reruns=1))


def copy_small_plans(data: Path) -> None:
    """Copy the cached plans of heads with a small sensor into the data folder of a server, if there are any."""
    if SMALL_PLANS.is_dir():
        shutil.copytree(SMALL_PLANS, data / "plans")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Server:
    """`diffuscope run` as a process with its own port and data folder; it can be stopped and restarted."""

    def __init__(self, data: Path, source: str = "hardware/heads/sim.toml", kind: str = "--head") -> None:
        self.data, self._source = data, (kind, source)
        self.before: list[str] = []  # prefix of the command, such as `nice`
        self.more: list[str] = []  # additional arguments of `run`
        self.first_on_path: Path | None = None  # first entry of PYTHONPATH; its metadata sets the version
        self.ready_path = "/api/status"
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._log = (data.parent / "server.log").open("ab")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Launch the process without waiting; on a new computer the first start measures FFT plans for 30 s."""
        command = [*self.before, str(Path(sys.executable).parent / "diffuscope"), "run", *self._source]
        command += ["--port", str(self.port), "--data", str(self.data), *self.more]
        place = {"PYTHONPATH": str(self.first_on_path)} if self.first_on_path else {}
        self._process = subprocess.Popen(command, cwd=ROOT, env=os.environ | place, stdout=self._log, stderr=self._log)

    def wait_until_ready(self, limit_s: float = 300) -> None:
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            assert self._process is not None
            assert self._process.poll() is None, f"the server ended: {Path(self._log.name).read_text()[-2000:]}"
            try:
                with urllib.request.urlopen(f"{self.url}{self.ready_path}", timeout=2) as answer:
                    answer.read()
                return
            except OSError:
                time.sleep(0.1)
        raise AssertionError(f"no answer in {limit_s} s: {Path(self._log.name).read_text()[-2000:]}")

    def stop(self) -> None:
        if self._process is not None:
            self.signal(signal.SIGCONT)
            self._process.terminate()
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def close(self) -> None:
        self.stop()
        self._log.close()


# Ignored console messages: the tests read pixels back more often than a page would, with a software renderer.
ADVICE = ("willReadFrequently", "GPU stall due to ReadPixels")


@dataclass
class Complaints:
    """Console messages and failed requests of the pages; `expect` adds regular expressions of expected ones."""

    messages: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)

    def expect(self, *patterns: str) -> None:
        self.expected.extend(patterns)

    def unexpected(self) -> list[str]:
        return [line for line in self.messages if not any(re.search(pattern, line) for pattern in self.expected)]

    def watch(self, page: Page) -> None:
        def console(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning") and not any(advice in message.text for advice in ADVICE):
                self.messages.append(f"console {message.type}: {message.text} ({message.location.get('url')})")

        def failed(request: Request) -> None:
            if request.failure != "net::ERR_ABORTED":  # aborted by the page itself
                self.messages.append(f"request failed: {request.url} {request.failure}")

        page.on("console", console)
        page.on("pageerror", lambda error: self.messages.append(f"page error: {error}"))
        page.on("requestfailed", failed)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A browser of the tests of one file: while Playwright runs, no other test of its process can use asyncio.run."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The real server in its own process, shared by all tests."""
    server = Server(tmp_path_factory.mktemp("server") / "data")
    if PLANS.is_dir():
        shutil.copytree(PLANS, server.data / "plans")
    server.start()
    yield server
    server.close()
    if (server.data / "plans").is_dir():
        shutil.copytree(server.data / "plans", PLANS, dirs_exist_ok=True)


@pytest.fixture
def server(launched: Server) -> Server:
    launched.wait_until_ready()
    return launched


@pytest.fixture(scope="session")
def instruments(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Instruments]:
    made = Instruments(lambda: tmp_path_factory.mktemp("real"))
    yield made
    made.close()


@pytest.fixture
def undo() -> Iterator[ExitStack]:
    """What ends after the pages are closed: a page reports a server that goes away."""
    with ExitStack() as undo:
        yield undo


@pytest.fixture
def real(instruments: Instruments, undo: ExitStack) -> Real:
    """A real instrument of this test alone, in this process."""
    real = instruments.take()
    undo.callback(real.close)
    return real


MakeReal = Callable[..., Real]


@pytest.fixture
def make_real(instruments: Instruments, undo: ExitStack) -> MakeReal:
    """A factory of instruments with other parts than `real`: see `Real`."""

    def make(*args: Any, **options: Any) -> Real:
        real = instruments.build(*args, **options)
        undo.callback(real.close)
        return real

    return make


@pytest.fixture(scope="session")
def standing_alerts(instruments: Instruments) -> Iterator[StandingAlerts]:
    with ExitStack() as undo:
        yield StandingAlerts(instruments, undo)


@pytest.fixture
def complaints() -> Complaints:
    return Complaints()


Open = Callable[..., Page]


@pytest.fixture
def open_page(browser: Browser, complaints: Complaints, undo: ExitStack) -> Iterator[Open]:
    """A factory of touch pages, `open_page(url, size=(width, height), **context options)`; console messages are
    recorded.
    """
    contexts: list[BrowserContext] = []

    def opened(url: str, size: tuple[int, int] = TABLET, **options: object) -> Page:
        width, height = size
        settings = {"viewport": {"width": width, "height": height}, "has_touch": True, "is_mobile": True, **options}
        contexts.append(browser.new_context(**settings))  # type: ignore[arg-type]
        page = contexts[-1].new_page()
        page.set_default_timeout(PATIENCE_MS)
        complaints.watch(page)
        page.goto(url)
        return page

    yield opened
    unexpected = complaints.unexpected()
    for context in contexts:
        for page in context.pages:
            page.goto("about:blank")  # the page sends its release of the camera, which a closed context would not
        context.close()
    assert unexpected == []


@pytest.fixture
def page(open_page: Open, server: Server) -> Page:
    """A tablet page on the real server."""
    return open_page(server.url)
