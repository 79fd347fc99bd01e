"""`diffuscope run` as a process: killed during a capture, restarted, ended by a signal."""

import http.client
import json
import signal
import socket
import ssl
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import tifffile

from device.clock import SystemClock
from device.errors import InputError
from services.http.server import Certificate, bind_socket, require_protection
from services.identity.certificates import create_authority, create_server_certificate
from services.identity.users import ROLES, UserTable
from tests.journey.conftest import COMMAND, ROOT, Diffuscope


class Server:
    """`diffuscope run` with the small head, and requests to it."""

    def __init__(self, head: Path, data: Path, environment: dict[str, str], *more: str) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._command = [COMMAND, "run", "--head", str(head), "--port", str(self.port), "--data", str(data)]
        self._command += more
        self._log = data.with_suffix(".log")
        self._environment = environment
        self.trusted: ssl.SSLContext | None = None  # of a page that is served by TLS

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        with self._log.open("ab") as log:
            process = subprocess.Popen(self._command, cwd=ROOT, env=self._environment, stdout=log, stderr=log)
        try:
            self._wait(process)
            yield process
        finally:
            process.kill()
            process.wait()

    def output(self) -> str:
        return self._log.read_text()

    def _wait(self, process: subprocess.Popen[bytes]) -> None:
        end = time.monotonic() + 300
        while time.monotonic() < end:
            assert process.poll() is None, self.output()
            try:
                self.ask("GET", "/api/status")
                return
            except OSError:
                time.sleep(0.05)
        raise AssertionError(f"no answer in 90 s: {self.output()}")

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        url = f"{'http' if self.trusted is None else 'https'}://127.0.0.1:{self.port}{path}"
        request = urllib.request.Request(url, data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=90, context=self.trusted) as answer:
            content = answer.read()
        return json.loads(content) if answer.headers["content-type"] == "application/json" else content

    def listed(self) -> list[str]:
        return [capture["id"] for capture in self.ask("GET", "/api/captures")["captures"]]

    @contextmanager
    def listening(self) -> Iterator[http.client.HTTPResponse]:
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)) as connection:
            connection.request("GET", "/api/events")
            stream = connection.getresponse()
            assert stream.readline() == b"event: beat\n"
            yield stream


ANSWERS = {"age": 54, "consent": "agreed"}


def test_server_restarts_with_stored_captures_after_a_kill_and_ends_on_sigterm(
    served_head: Path, environment: dict[str, str], tmp_path: Path, diffuscope: Diffuscope
) -> None:
    server = Server(served_head, tmp_path / "data", environment)
    with server.running() as process:
        visit = server.ask("POST", "/api/visits", {"key": "0" * 16})["id"]
        server.ask("PATCH", f"/api/visits/{visit}", {"key": "1" * 16, "field": "age", "value": 54})
        server.ask("PATCH", f"/api/visits/{visit}", {"key": "3" * 16, "field": "consent", "value": "agreed"})
        where = {"visit": visit, "key": "2" * 16}
        kept = [server.ask("POST", "/api/captures", {"eye": "OD", "slot": "R-centre", **where})["id"]]
        kept.append(server.ask("POST", "/api/captures", {"eye": "OS"})["id"])
        second = diffuscope("run", "--head", served_head, "--port", server.port, "--data", tmp_path / "other")
        assert second.returncode == 2
        assert "cannot be served" in second.stderr
        assert f"--port {server.port + 1}" in second.stderr
        assert not (tmp_path / "other").exists()
        wrong = tmp_path / "programme.toml"
        wrong.write_text("retakes = 2\n")
        third = diffuscope("run", "--head", served_head, "--programme", wrong)
        assert (third.returncode, "programme.toml" in third.stderr) == (2, True)
        with ThreadPoolExecutor(1) as aside:
            pressed = aside.submit(server.ask, "POST", "/api/captures", {"eye": "OD"})
            while server.ask("GET", "/api/status")["state"] != "busy" and not pressed.done():
                time.sleep(0.002)
            process.send_signal(signal.SIGKILL)
            interrupted = pressed.exception(20)
        assert isinstance(interrupted, (OSError, http.client.HTTPException))
    with server.running() as process:
        listed = server.listed()
        assert listed[-2:] == kept[::-1]
        (unfinished,) = server.ask("GET", "/api/visits?open=true")["visits"]  # the visit open before the kill
        assert (unfinished["id"], unfinished["fields"], unfinished["next_slot"]) == (visit, ANSWERS, "R-nerve")
        assert unfinished["slots"]["R-centre"]["capture"] == kept[0]
        assert server.ask("POST", "/api/captures", {"eye": "OD", "slot": "R-centre", **where})["id"] == kept[0]
        for id in listed:  # includes a third capture if the kill came after its storage
            for name in ("raw.tiff", "picture.png", "quick.jpg", "report.json"):
                assert server.ask("GET", f"/api/captures/{id}/{name}")
            assert tifffile.imread(BytesIO(server.ask("GET", f"/api/captures/{id}/raw.tiff"))).shape == (136, 240)
        assert server.ask("POST", "/api/captures", {"eye": "OD"})["id"] not in listed
        with ExitStack() as undo:
            streams = [undo.enter_context(server.listening()) for _ in range(3)]
            process.send_signal(signal.SIGTERM)
            process.wait(10)
            for stream in streams:
                stream.read()  # a truncated chunked body would raise
    assert "Traceback" not in server.output()
    assert "Cancel" not in server.output()  # the server's word when it waited for streams in vain


def test_a_data_folder_of_a_version_before_the_first_release_is_refused_before_the_head_is_opened(
    diffuscope: Diffuscope, tmp_path: Path
) -> None:
    """The head's camera is missing here: it would be the error if the head were opened first."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "shelf.sqlite").write_bytes(b"its tables")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    done = diffuscope("run", "--head", "hardware/heads/imx296.toml", "--port", port, "--data", tmp_path / "data")
    assert done.returncode == 2
    assert "was written by a version before the first release, which cannot be read here" in done.stderr
    assert "Give another folder with --data" in done.stderr
    assert "Traceback" not in done.stderr
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["shelf.sqlite"]


def test_an_address_beyond_this_computer_needs_a_user_and_tls(tmp_path: Path) -> None:
    """Socket and table of the users decide, before any part of a head is opened."""
    users, certificate = UserTable(tmp_path), Certificate(tmp_path / "crt.pem", tmp_path / "key.pem")
    with bind_socket("127.0.0.1", 0) as own, bind_socket("0.0.0.0", 0) as open_to_all:
        for tls in (None, certificate):
            require_protection(own, users, tls)
            with pytest.raises(InputError, match="no user exists yet") as refusal:
                require_protection(open_to_all, users, tls)
            assert "users add" in refusal.value.remedy
        users.add("Asha", "274913", ROLES)
        with pytest.raises(InputError, match="no certificate"):
            require_protection(open_to_all, users, None)
        require_protection(open_to_all, users, certificate)


def test_the_page_is_served_by_tls_with_given_files(
    served_head: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    authority = create_authority("eye", SystemClock())
    for name, content in zip(
        ("key.pem", "crt.pem"), create_server_certificate(*authority, "eye", SystemClock()), strict=True
    ):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "authority.pem").write_bytes(authority[1])
    words = ("--certificate", str(tmp_path / "crt.pem"), "--certificate-key", str(tmp_path / "key.pem"))
    server = Server(served_head, tmp_path / "data", environment, *words)
    server.trusted = ssl.create_default_context(cafile=str(tmp_path / "authority.pem"))
    server.trusted.check_hostname = False  # the names of the certificate are those of a device
    with server.running():
        assert server.ask("GET", "/api/login")["user"]["is_demo"]
        assert "Open https://127.0.0.1" in server.output()
