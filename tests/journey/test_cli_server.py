"""`diffuscope run` as a process: killed during a capture, restarted, ended by a signal."""

import hashlib
import http.client
import json
import re
import signal
import socket
import ssl
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import httpx
import pytest
import tifffile
from starlette.requests import Request

from device import atomic_io
from device.clock import SystemClock, VirtualClock
from device.errors import InputError
from services.http.server import open_listeners
from services.http.static_files import page_files
from services.identity.certificates import create_authority, create_server_certificate
from tests.journey.conftest import COMMAND, ROOT, Diffuscope, until


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
        self.ready_path = "/api/status"

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
                self.ask("GET", self.ready_path)
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


def test_an_address_beyond_this_computer_needs_tls(tmp_path: Path) -> None:
    """The certificate decides, before any part of a head is opened; an expired or foreign one is none."""
    [own] = open_listeners({}, "127.0.0.1", 0, tmp_path, 0)
    with own.socket:
        assert (own.is_local, own.certificate) == (True, None)
    with pytest.raises(InputError, match="the network is served by TLS") as refusal:
        open_listeners({}, "0.0.0.0", 0, tmp_path, 0)
    assert "diffuscope label" in refusal.value.remedy
    authority = create_authority("eye", SystemClock())
    (tmp_path / "authority.crt").write_bytes(authority[1])
    for moment in (datetime(2999, 1, 1, tzinfo=UTC), datetime.now(UTC)):  # the first is not expired before 3000
        pem = create_server_certificate(*authority[:2], "eye", VirtualClock(moment))
        (tmp_path / "server.pem").write_bytes(pem)
        [page, pairing] = open_listeners({}, "0.0.0.0", 0, tmp_path, free_port())
        with page.socket, pairing.socket:
            assert (page.certificate, pairing.certificate) == (tmp_path / "server.pem", None)
            assert [one.is_pairing for one in (page, pairing)] == [False, True]
    other = create_server_certificate(*authority[:2], "eye", SystemClock()).partition(b"-----BEGIN CERTIFICATE")[0]
    (tmp_path / "server.pem").write_bytes(other + pem[pem.index(b"-----BEGIN CERTIFICATE") :])
    with pytest.raises(InputError, match="cannot be used with its key"):
        open_listeners({}, "0.0.0.0", 0, tmp_path, 0)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_replaced_certificate_is_served_without_a_restart_and_nothing_but_pairing_before_the_first_user(
    served_head: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    """Address changed: the page answers by TLS, and pairing by plain HTTP; a damaged certificate changes nothing."""
    tls, pairing_port = tmp_path / "data/tls", free_port()
    tls.mkdir(parents=True)
    authority = create_authority("eye", SystemClock())
    for name, pem in (("authority.crt", authority[1]), ("authority-unconstrained.crt", authority[2])):
        (tls / name).write_bytes(pem)
    write_leaf(tls, authority, "127.0.0.1")
    words = ("--host", "0.0.0.0", "--pairing-port", str(pairing_port))
    server = Server(served_head, tmp_path / "data", environment, *words)
    server.trusted = ssl.create_default_context(cafile=str(tls / "authority.crt"))
    server.ready_path = "/api/login"
    with server.running():
        assert server.ask("GET", "/api/login") == {"user": None, "needs_setup": True, "idle_s": 300.0}
        for path in ("/api/visits", "/api/captures", "/api/users", "/api/audit", "/api/openapi.json"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                server.ask("GET", path)
            assert json.loads(refused.value.read())["code"] == "access.setup"
        plain(pairing_port, server.port, authority)
        before = leaf_of(server.port)
        (tls / "server.pem").write_bytes(b"damaged")
        time.sleep(2.5)  # two looks at the file
        assert leaf_of(server.port) == before
        write_leaf(tls, authority, "10.1.2.3")
        until(lambda: leaf_of(server.port) != before)
        with pytest.raises(urllib.error.URLError, match="IP address mismatch"):
            server.ask("GET", "/api/login")  # a tablet at the old address, which the device no longer has
        log = "".join(file.read_text() for file in (tmp_path / "data/event-log").iterdir())
        assert "the certificate was replaced and cannot be used" in log


def write_leaf(tls: Path, authority: tuple[bytes, bytes, bytes], address: str) -> None:
    pem = create_server_certificate(*authority[:2], "eye", SystemClock(), [ip_address(address)])
    atomic_io.write_atomically(tls / "server.pem", pem)


def leaf_of(port: int) -> str:
    return ssl.get_server_certificate(("127.0.0.1", port))


def plain(port: int, https_port: int, authority: tuple[bytes, bytes, bytes]) -> None:
    """Check the pairing page: itself, its files, the authorities, and nothing else; no cookie, no redirection."""
    with httpx.Client(base_url=f"http://127.0.0.1:{port}") as tablet:
        digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(authority[1].decode())).hexdigest()
        page = tablet.get("/")
        assert bytes.fromhex(digest).hex(" ").upper() in page.text
        assert f'data-port="{https_port}"' in page.text
        assert page.status_code == 200
        assert tablet.get(re.findall(r'src="(/web/[^"]+)"', page.text)[0]).status_code == 200
        for name, pem in (("authority", authority[1]), ("authority-unconstrained", authority[2])):
            answer = tablet.get(f"/{name}.crt")
            assert (answer.headers["content-type"], answer.content) == ("application/x-x509-ca-cert", pem)
        exam = page_files().answer(Request({"type": "http", "headers": []}), "index.html", "").body.decode()
        others = ["/api/login", "/api/status", "/technician", "/server.crt", "/authority.key", "/docs", "/openapi.json"]
        others += re.findall(r'src="(/web/[^"]+)"', exam)
        assert [tablet.get(path).status_code for path in others] == [404] * 3 + [422] + [404] * 4
        assert tablet.post("/api/setup", json={}).status_code == 404
        assert tablet.post("/", content=b"x" * 100_000).status_code == 405
        assert tablet.get("/", headers={"Host": "evil.example"}).status_code == 400
        assert not tablet.cookies
        assert page.headers["Cross-Origin-Resource-Policy"] == "same-origin"
