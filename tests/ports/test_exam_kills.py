"""Kill tests of the whole instrument with the real ring on an emulated SPI bus, during aiming and during a press."""

import json
import os
import random
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.cookiejar import CookieJar
from pathlib import Path
from threading import Thread

import pytest

from services.identity.users import FOLDER, ROLES, UserTable
from tests.ports.conftest import HEAD
from tests.ports.emulators.kills import Sleeper
from tests.ports.emulators.wires import EmulatedBuses, emulated_buses

ROOT = HEAD.parents[2]
PIN = "274913"
READY_S = 300.0  # TimeoutStartSec of the unit: the first start compiles kernels and measures FFTs
MIXED = '[light]\nbackend = "apa102"'


class Instrument:
    """`diffuscope run` with a simulated camera lit by the real ring, and a client that polls and presses."""

    def __init__(self, folder: Path) -> None:
        self.head = folder / "mixed.toml"
        text = HEAD.read_text(encoding="utf-8").replace('[light]\nbackend = "sim"', MIXED)
        text = text.replace("rows = 1080", "rows = 270").replace("cols = 1920", "cols = 480").replace("5.04", "20.16")
        self.head.write_text(text + "\n[light.chain]\n", encoding="utf-8")
        self.data = folder / "data"
        UserTable(self.data / FOLDER).add("Asha", PIN, ROLES)  # a real ring has no demonstration user
        self.cookies = CookieJar()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        arguments = ["run", "--head", str(self.head), "--port", str(self.port), "--data", str(self.data)]
        command = [sys.executable, "-c", "from services.cli import main; main()", *arguments]
        process = subprocess.Popen(command, cwd=ROOT, env=os.environ.copy(), stdout=subprocess.DEVNULL)
        try:
            self.wait_until(lambda: self.ask("/api/login", json.dumps({"name": "Asha", "secret": PIN}).encode()))
            self.wait_until(lambda: self.ask("/api/preview?after=0") is not None)
            yield process
        finally:
            process.kill()
            process.wait()

    def wait_until(self, ready) -> None:
        end_s = time.monotonic() + READY_S
        while time.monotonic() < end_s:
            with suppress(OSError):
                if ready():
                    return
            time.sleep(0.1)
        raise AssertionError("the instrument did not get ready")

    def ask(self, path: str, body: bytes | None = None) -> bytes | None:
        head = {"X-Controller": "test"} | ({"Content-Type": "application/json"} if body else {})
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", data=body, headers=head)
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(self.cookies))
        with opener.open(request, timeout=20) as answer:
            return answer.read() if answer.status != 204 else None

    def use(self) -> None:
        """Poll the preview and press until the server no longer answers."""
        with suppress(OSError):
            for number in range(1000):
                self.ask(f"/api/preview?after={number}")
                if number % 2:
                    self.ask("/api/captures", b'{"eye": "OD"}')


@pytest.fixture
def sound_wires() -> EmulatedBuses:
    emulated_buses().set_faults()
    return emulated_buses()


def dark_after_s(chain: EmulatedBuses, moment_s: float) -> float:
    """Return the time from a moment to the message that turned the last LED off; the ring must then stay off."""
    time.sleep(0.5)
    assert not chain.lit
    later = [message["at_s"] for message in chain.messages if message["at_s"] > moment_s]
    lit = [message["at_s"] for message in chain.messages if message["lit"]]
    before = [message for message in chain.messages if message["at_s"] <= moment_s]
    if not before[-1]["lit"] and (not lit or lit[-1] <= moment_s):
        return 0.0
    return min(at_s for at_s in later if at_s > max(lit)) - moment_s


@pytest.mark.parametrize("seed", range(2))
def test_killing_the_instrument_in_use_leaves_no_light(tmp_path, sound_wires, seed):
    instrument = Instrument(tmp_path)
    with instrument.running() as process, Sleeper() as sleeper:
        seen = len(sound_wires.messages)
        user = Thread(target=instrument.use)
        user.start()
        # Slow on a busy machine.
        instrument.wait_until(lambda: any(message["lit"] for message in sound_wires.messages[seen:]))
        time.sleep(random.Random(seed).uniform(0.2, 1.2))
        process.kill()
        died_s = time.monotonic()
        process.wait()
        user.join()
        after_s = dark_after_s(sound_wires, died_s)
        limit_s = sleeper.dark_limit_s(died_s, died_s + after_s)
    assert any(message["lit"] for message in sound_wires.messages[seen:])
    assert after_s <= limit_s
