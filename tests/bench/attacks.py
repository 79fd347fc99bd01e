"""`make bench-attacks`: status and press of the real server while clients hold connections that they do not use.

Each attack runs twice: from the address of the screen itself (127.0.0.1, `own`) and from another address of this
computer. Columns: longest status while the attack opens its connections, then longest status and press while it holds
them, which have limits. The server runs with the number of open files of its unit. `--tree FOLDER` measures another
checkout with its own `.venv`.
"""

import argparse
import configparser
import http.client
import json
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from threading import Event
from typing import Any

from device.clock import SystemClock
from services.identity.certificates import create_authority, create_server_certificate
from services.identity.users import FOLDER, ROLES, UserTable
from tests.bench import timing
from tests.bench.attackers import ATTACKS, REOPEN_S, under_attack, untrusting_context

ROOT = Path(__file__).parents[2]
PIN = "274913"
DEFAULT_FILES = 1024  # soft limit of systemd for a unit without LimitNOFILE
STATUS_S, PRESS_S, LOG_MB_PER_MIN = 0.2, 1.5, 1.0
ASK_EVERY_S, PRESS_EVERY_S, TIMEOUT_S = 0.25, 2.0, 15.0
OPENING_S = 3.0  # in which an attack opens its connections, all at once
UNREACHABLE = "192.0.2.1"  # of the block for documentation: no packet is sent to it


@dataclass
class Seen:
    """Latencies in seconds of status and press, and the requests that failed (by reason)."""

    status_s: list[float] = field(default_factory=list)
    press_s: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)


class Instrument:
    """`diffuscope run` of one tree with the simulated head, at the open files of its unit.

    `is_open`: served to the whole network, so by TLS and for a user who signs in.
    """

    def __init__(self, tree: Path, data: Path, is_open: bool = False) -> None:
        self._tree, self._data, self._log, self._is_open = tree, data, data.with_suffix(".log"), is_open
        self._cookie = ""
        self.files = unit_files(tree)
        with socket.socket() as probe:
            probe.bind(("", 0))
            self.port: int = probe.getsockname()[1]

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        """Run the server until the end of the context, from the moment on when it accepts a press."""
        words = ["run", "--head", "hardware/heads/sim.toml", "--port", str(self.port)]
        if self._is_open:
            self._write_identity()
            words += ["--host", "0.0.0.0", "--tls", str(self._data)]
        command = [str(self._tree / ".venv/bin/diffuscope"), *words, "--data", str(self._data)]
        with self._log.open("wb") as log:
            process = subprocess.Popen(command, cwd=self._tree, stdout=log, stderr=log, preexec_fn=self._limit_files)
        try:
            end_s = time.monotonic() + 300
            while self._state() != "aim":
                assert process.poll() is None, self._log.read_text()
                assert time.monotonic() < end_s, self._log.read_text()
                time.sleep(0.5)
            if self._is_open:
                self.ask("POST", "/api/login", {"name": "Asha", "secret": PIN})
            yield process
        finally:
            process.terminate()
            process.wait(90)

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """Send one request on a connection of its own; return the answer. OSError for no answer or another status."""
        content = None if body is None else json.dumps(body)
        headers = {"Content-Type": "application/json", "Connection": "close", "Cookie": self._cookie}
        with closing(self._connection()) as connection:
            connection.request(method, path, content, headers)
            answer = connection.getresponse()
            read = answer.read()
        self._cookie = (answer.headers.get("Set-Cookie") or self._cookie).partition(";")[0]
        if answer.status not in (200, 201):
            raise OSError(f"status {answer.status}")
        return json.loads(read)

    def log_bytes(self) -> int:
        """Return the size of the log."""
        return self._log.stat().st_size

    def _connection(self) -> http.client.HTTPConnection:
        if self._is_open:
            return http.client.HTTPSConnection("127.0.0.1", self.port, timeout=TIMEOUT_S, context=untrusting_context())
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_S)

    def _write_identity(self) -> None:
        """Add the user of the presses, and write a key with its certificate."""
        if not (users := UserTable(self._data / FOLDER)).has_begun:
            users.add("Asha", PIN, ROLES)
        authority = create_authority("bench", SystemClock())[:2]
        (self._data / "server.pem").write_bytes(create_server_certificate(*authority, "bench", SystemClock()))

    def _state(self) -> str | None:
        try:
            return str(self.ask("GET", "/api/status")["state"])
        except (OSError, http.client.HTTPException):
            return None

    def _limit_files(self) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (self.files, self.files))


def main() -> int:
    """Measure without an attack, then during each one; return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout to measure, with its .venv")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each attack")
    parser.add_argument("--only", action="append", choices=list(ATTACKS), help="just this attack; may be repeated")
    parser.add_argument("--reopen", type=float, default=REOPEN_S, help="seconds until a closed connection is reopened")
    words = parser.parse_args()
    sources = {"own": "127.0.0.1", "other": own_address()}
    with tempfile.TemporaryDirectory() as folder:
        instrument = Instrument(words.tree.resolve(), Path(folder) / "data", is_open=True)
        with instrument.running() as process:
            print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {instrument.files} open files")
            columns = ("requests", "failed", "opening", "status", "press", "MB/min", "MB", "threads", "files", "limit")
            timing.head("attack, address; longest times in s", *columns)
            is_kept = [measured(instrument, process.pid, "none", None, words.seconds)]
            for name in words.only or ATTACKS:
                for source, host in sources.items():
                    if host is not None:
                        row = f"{name}, {source}"
                        is_kept.append(measured(instrument, process.pid, row, host, words.seconds, words.reopen))
                        time.sleep(3)
    return 0 if all(is_kept) else 1


def measured(
    instrument: Instrument, process: int, name: str, host: str | None, seconds: float, reopen_s: float = REOPEN_S
) -> bool:
    """Measure status, press and log during an attack from `host` (None: without one); return whether limits hold."""
    before = instrument.log_bytes()
    begin_s = time.monotonic()
    attack = nullcontext() if host is None else under_attack(name.split(",")[0], host, instrument.port, reopen_s)
    with attack:
        opening = watch(instrument, OPENING_S)
        seen, size = watch(instrument, seconds), process_size(process)
    log_mb = (instrument.log_bytes() - before) / 1e6 / (time.monotonic() - begin_s) * 60
    status_s, press_s = max(seen.status_s, default=TIMEOUT_S), max(seen.press_s, default=TIMEOUT_S)
    failed = opening.failed + seen.failed
    share = max(status_s / STATUS_S, press_s / PRESS_S, log_mb / LOG_MB_PER_MIN, 2.0 if failed else 0.0)
    count = sum(len(part.status_s) + len(part.press_s) for part in (opening, seen))
    cells = (str(count), str(len(failed)), max(opening.status_s), status_s, press_s, log_mb, *size)
    timing.row(name, *cells, limit=1.0, value=share)
    for reason in sorted(set(failed)):
        print(f"    {failed.count(reason)} x {reason}")
    return share <= 1.0


def watch(instrument: Instrument, seconds: float) -> Seen:
    """Ask for the status and press for some seconds, each in a thread of its own; return what was seen."""
    seen, is_over, eyes = Seen(), Event(), cycle(("OD", "OS"))

    def repeat(latencies: list[float], every_s: float, act: Callable[[], object]) -> None:
        while not is_over.wait(every_s):
            begin_s = time.perf_counter()
            try:
                act()
            except (OSError, http.client.HTTPException) as error:
                seen.failed.append(f"{type(error).__name__}: {error}"[:80])
            latencies.append(time.perf_counter() - begin_s)

    with ThreadPoolExecutor(2) as threads:
        status = threads.submit(repeat, seen.status_s, ASK_EVERY_S, lambda: instrument.ask("GET", "/api/status"))
        press = threads.submit(
            repeat, seen.press_s, PRESS_EVERY_S, lambda: instrument.ask("POST", "/api/captures", {"eye": next(eyes)})
        )
        time.sleep(seconds)
        is_over.set()
        status.result()
        press.result()
    return seen


def process_size(process: int) -> tuple[str, str, str]:
    """Return resident memory in MB, number of threads and number of open files of a process."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    files = len(list(Path(f"/proc/{process}/fd").iterdir()))
    return f"{int(lines['VmRSS'].split()[0]) / 1024:.0f}", lines["Threads"].strip(), str(files)


def unit_files(tree: Path) -> int:
    """Return the number of open files of the instrument's unit in a tree: LimitNOFILE, or systemd's default."""
    unit = configparser.ConfigParser(interpolation=None, delimiters="=", comment_prefixes="#", strict=False)
    unit.read_string((tree / "systemd" / "diffuscope.service").read_text(encoding="utf-8"))
    return int(unit["Service"].get("LimitNOFILE", str(DEFAULT_FILES)))


def own_address() -> str | None:
    """Return an address of this computer that is not loopback; None without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((UNREACHABLE, 9))
        except OSError:
            return None
        return str(probe.getsockname()[0])


if __name__ == "__main__":
    sys.exit(main())
