"""Watchdog notifications on a real sd_notify socket: only the loop that owns the head sends heartbeats."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from device.clock import SystemClock
from services.http.server import inherited_sockets
from services.identity.certificates import create_authority, create_server_certificate
from services.instrument.watchdog import BEAT_S, Watchdog
from tests.journey.conftest import ROOT, until


class NotifySocket:
    """Notification socket of systemd, read by a thread."""

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        self.received: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address)
        self._reader = Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        while (datagram := self._socket.recv(4096)) != b"enough":
            self.received.append(datagram.decode())

    def take_until(self, line: str) -> list[str]:
        """Wait for `line`; return the datagrams received since the last call."""
        until(lambda: line in self.received)
        received, self.received = self.received, []
        return received

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
            client.sendto(b"enough", self.address)
        self._reader.join()
        self._socket.close()


@pytest.fixture
def notify_socket(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NotifySocket]:
    notify_socket = NotifySocket(tmp_path_factory.mktemp("run") / "notify")
    yield notify_socket
    notify_socket.close()


def test_every_notification_is_one_sd_notify_datagram(notify_socket: NotifySocket) -> None:
    watchdog = Watchdog(notify_socket.address)
    watchdog.ready()
    watchdog.beat()
    watchdog.status("making\nplans")  # a second line would be a second notification
    watchdog.stopping()
    assert notify_socket.take_until("STOPPING=1") == ["READY=1", "WATCHDOG=1", "STATUS=making plans", "STOPPING=1"]


def test_an_abstract_socket_address_is_supported() -> None:
    name = f"diffuscope-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify_socket:
        notify_socket.bind(f"\0{name}")
        Watchdog(f"@{name}").beat()
        assert notify_socket.recv(64) == b"WATCHDOG=1"


def test_without_a_listener_nothing_is_raised(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Watchdog(None).beat()
    assert not caplog.records
    Watchdog(str(tmp_path / "gone")).beat()
    assert "sd_notify failed for WATCHDOG=1" in caplog.text


def test_ready_follows_planning_and_stopping_precedes_the_end(make_rig: Any, notify_socket: NotifySocket) -> None:
    rig = make_rig(watchdog=notify_socket.address)
    received = notify_socket.take_until("STATUS=aim")
    assert received[:3] == ["STATUS=making plans", "READY=1", "STATUS=aim"]  # and perhaps the first heartbeat
    rig.arbiter.close()
    notify_socket.take_until("STOPPING=1")


def test_an_idle_head_thread_sends_heartbeats(make_rig: Any, notify_socket: NotifySocket) -> None:
    make_rig(watchdog=notify_socket.address)
    notify_socket.take_until("STATUS=aim")
    time.sleep(2.5 * BEAT_S)
    assert set(notify_socket.received) == {"WATCHDOG=1"}
    assert 2 <= len(notify_socket.received) <= 4


def test_a_refinement_sends_heartbeats_between_its_rounds(make_rig: Any, notify_socket: NotifySocket) -> None:
    rig = make_rig(watchdog=notify_socket.address)
    notify_socket.take_until("STATUS=aim")
    kept = rig.exam.press("OD").result(30)
    received = notify_socket.take_until("STATUS=aim")
    assert received.count("WATCHDOG=1") > kept.report.rounds


def test_a_check_of_a_stored_capture_sends_heartbeats(make_rig: Any, notify_socket: NotifySocket) -> None:
    rig = make_rig(watchdog=notify_socket.address)
    notify_socket.take_until("STATUS=aim")
    rig.exam.press("OD").result(30)
    until(lambda: notify_socket.received.count("STATUS=aim") == 1 and not rig.exam.calibration_monitor.has_pending)
    after = notify_socket.received[notify_socket.received.index("STATUS=aim") :]
    assert after.count("WATCHDOG=1") > 5  # an idle head thread sends one in two seconds


def test_a_blocked_head_thread_sends_no_heartbeats(make_rig: Any, notify_socket: NotifySocket) -> None:
    """The HTTP server and all other threads run; they send no heartbeats."""
    rig = make_rig(watchdog=notify_socket.address)
    notify_socket.take_until("STATUS=aim")
    rig.block_exposures()
    answer = rig.exam.press("OD")
    rig.wait_for_blocked_exposure()
    received = len(notify_socket.received)
    time.sleep(2 * BEAT_S)
    assert len(notify_socket.received) == received
    assert rig.request("GET", "/api/status").status_code == 200
    rig.clock.gate.set()
    answer.result(30)
    assert "WATCHDOG=1" in notify_socket.take_until("STATUS=aim")


def test_a_passed_socket_is_accepted_only_by_its_addressee() -> None:
    assert inherited_sockets({}) == {}
    assert inherited_sockets({"LISTEN_PID": str(os.getpid() + 1), "LISTEN_FDS": "1"}) == {}
    assert inherited_sockets({"LISTEN_PID": str(os.getpid())}) == {}


def test_passed_sockets_are_ordered_by_the_names_of_their_units(tmp_path: Path) -> None:
    """In a process of its own, whose first sockets have the numbers 3 to 5, as those of systemd, the page last.

    The first listener runs the application's start and end. Without a certificate it is the only one.
    """
    authority = create_authority("eye", SystemClock())
    (tmp_path / "authority.crt").write_bytes(authority[1])
    (tmp_path / "server.pem").write_bytes(create_server_certificate(*authority[:2], "eye", SystemClock()))
    code = """
import os, socket, sys
from pathlib import Path
made = [socket.create_server((host, 0)) for host in ("0.0.0.0", "0.0.0.0", "127.0.0.1")]
pairing, network, page = [one.getsockname()[1] for one in made]
assert [one.detach() for one in made] == [3, 4, 5]
from services.http.server import open_listeners
names = (f"diffuscope{part}.socket" for part in ("-pairing", "-network", ""))
given = {"LISTEN_PID": str(os.getpid()), "LISTEN_FDS": "3", "LISTEN_FDNAMES": ":".join(names)}
tls = Path(sys.argv[1])
found = open_listeners(given, "", 0, tls, 0)
stated = [(one.socket.getsockname()[1], one.certificate, one.is_pairing) for one in found]
assert stated == [(page, None, False), (network, tls / "server.pem", False), (pairing, None, True)], stated
[one.socket.detach() for one in found]
(tls / "server.pem").unlink()
assert [one.socket.getsockname()[1] for one in open_listeners(given, "", 0, tls, 0)] == [page]
"""
    subprocess.run([sys.executable, "-c", code, tmp_path], cwd=ROOT, check=True)
