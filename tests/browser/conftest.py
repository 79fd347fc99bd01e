"""The real server, the stand-in, and a touch page that fails its test for anything unexpected in the console."""

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
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, sync_playwright

from tests.browser.stub import Stub, Stubbed

ROOT = Path(__file__).parents[2]
PLANS = ROOT / "out" / "browser-plans"  # what the first start measured about this computer; `make clean` forgets it
CHROMIUM = "/usr/bin/chromium-headless-shell"
TABLET = (1280, 800)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Server:
    """`diffuscope run` as a process of its own, on one port and one shelf, that can be stopped and started again."""

    def __init__(self, data: Path, source: str = "hardware/heads/sim.toml", kind: str = "--head") -> None:
        self.data, self._source = data, (kind, source)
        self.before: list[str] = []  # words before the command, such as `nice`
        self.more: list[str] = []  # words for `run`
        self.first_on_path: Path | None = None  # where Python looks first: what a version is called
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._log = (data.parent / "server.log").open("ab")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Launch the process without waiting for it; the first start measures the computer for half a minute."""
        command = [*self.before, str(Path(sys.executable).parent / "diffuscope"), "run", *self._source]
        command += ["--port", str(self.port), "--data", str(self.data), *self.more]
        place = {"PYTHONPATH": str(self.first_on_path)} if self.first_on_path else {}
        self._process = subprocess.Popen(command, cwd=ROOT, env=os.environ | place, stdout=self._log, stderr=self._log)

    def wait_until_ready(self, limit_s: float = 120) -> None:
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            assert self._process is not None
            assert self._process.poll() is None, f"the server ended: {Path(self._log.name).read_text()[-2000:]}"
            try:
                with urllib.request.urlopen(f"{self.url}/api/status", timeout=2) as answer:
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The journeys come last: the real server measures the computer in the meantime."""
    here = Path(__file__).parent
    items.sort(key=lambda item: item.path.parent == here and "server" in getattr(item, "fixturenames", ()))


# The tests read pixels back more often than a page would, and their graphics chip is a program, which must hand every
# picture back to the processor: the browser's advice about both is not for us.
ADVICE = ("willReadFrequently", "GPU stall due to ReadPixels")


@dataclass
class Complaints:
    """What the browser complained about; `expect` names, as regular expressions, what a test causes on purpose."""

    heard: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)

    def expect(self, *patterns: str) -> None:
        self.expected.extend(patterns)

    def unexpected(self) -> list[str]:
        return [line for line in self.heard if not any(re.search(pattern, line) for pattern in self.expected)]

    def watch(self, page: Page) -> None:
        def console(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning") and not any(advice in message.text for advice in ADVICE):
                self.heard.append(f"console {message.type}: {message.text} ({message.location.get('url')})")

        def failed(request: Request) -> None:
            if request.failure != "net::ERR_ABORTED":  # the page itself gives up a preview that it no longer needs
                self.heard.append(f"request failed: {request.url} {request.failure}")

        page.on("console", console)
        page.on("pageerror", lambda error: self.heard.append(f"page error: {error}"))
        page.on("requestfailed", failed)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="session", autouse=True)
def launched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One real server for all tests, which gets ready while those tests run that do not need it."""
    server = Server(tmp_path_factory.mktemp("shelf") / "data")
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
def standing_stub() -> Iterator[Stubbed]:
    with Stubbed(Stub(), free_port()) as stubbed:
        yield stubbed


@pytest.fixture
def stub(standing_stub: Stubbed) -> Stubbed:
    """The stand-in for the API, as new."""
    standing_stub.stub.reset()
    return standing_stub


@pytest.fixture
def complaints() -> Complaints:
    return Complaints()


Open = Callable[..., Page]


@pytest.fixture
def open_page(browser: Browser, complaints: Complaints) -> Iterator[Open]:
    """Open touch pages, `open_page(url, size=(width, height), **context options)`; every one is listened to."""
    contexts: list[BrowserContext] = []

    def opened(url: str, size: tuple[int, int] = TABLET, **options: object) -> Page:
        width, height = size
        settings = {"viewport": {"width": width, "height": height}, "has_touch": True, "is_mobile": True, **options}
        contexts.append(browser.new_context(**settings))  # type: ignore[arg-type]
        page = contexts[-1].new_page()
        page.set_default_timeout(15_000)
        complaints.watch(page)
        page.goto(url)
        return page

    yield opened
    heard = complaints.unexpected()
    for context in contexts:
        context.close()
    assert heard == []


@pytest.fixture
def page(open_page: Open, server: Server) -> Page:
    """A tablet on the real server."""
    return open_page(server.url)
