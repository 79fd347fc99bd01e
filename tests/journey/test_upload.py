"""Upload of finished visits by `diffuscope run --send`: once and complete, after kills of the instrument too."""

import hashlib
import io
import json
import signal
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.journey.conftest import Diffuscope, until
from tests.journey.test_cli_server import Server
from tests.receiver import Receiver, receiving
from tests.site import identity


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[Receiver]:
    with receiving(*identity(tmp_path)) as receiver:
        fields = receiver.settings(tmp_path, authority=tmp_path / "web.crt")
        (tmp_path / "send.toml").write_text(
            "".join(f"{name} = {json.dumps(fields[name], default=str)}\n" for name in fields)
        )
        yield receiver


def finished(server: Server, first: int) -> str:
    """Create one finished visit with one picture."""
    key = [f"{number:016x}" for number in range(first, first + 5)]
    visit: str = server.ask("POST", "/api/visits", {"key": key[0]})["id"]
    server.ask("PATCH", f"/api/visits/{visit}", {"key": key[1], "field": "name", "value": "Lakshmi Narayanan"})
    server.ask("PATCH", f"/api/visits/{visit}", {"key": key[2], "field": "consent", "value": "agreed"})
    server.ask("POST", "/api/captures", {"eye": "OD", "slot": "R-centre", "visit": visit, "key": key[3]})
    server.ask("POST", f"/api/visits/{visit}/finish", {"key": key[4]})
    return visit


def sending(server: Server) -> dict[str, int]:
    numbers: dict[str, int] = server.ask("GET", "/api/status")["sending"]
    return numbers


def test_each_visit_is_uploaded_once_and_complete_after_a_kill_during_the_upload(
    receiver: Receiver, served_head: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    server = Server(served_head, tmp_path / "data", environment, "--send", str(tmp_path / "send.toml"))
    with server.running() as process:
        until(lambda: server.ask("GET", "/api/status")["state"] == "aim", 120)
        finished(server, 0)
        until(lambda: sending(server) == {"sent": 1, "waiting": 0}, 60)
        receiver.asked.clear()
        receiver.after_put.clear()  # the next archive is stored, and its answer is lost
        finished(server, 16)
        until(lambda: receiver.asked == ["HEAD", "PUT", "HEAD"], 60)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert len(receiver.kept) == 2
    receiver.after_put.set()
    with server.running() as process:
        until(lambda: sending(server) == {"sent": 2, "waiting": 0}, 60)
        assert server.ask("GET", "/api/upload-queue")["visits"] == []
        receiver.gate.clear()
        requests = len(receiver.asked)
        finished(server, 32)
        until(lambda: len(receiver.asked) > requests, 60)
        process.send_signal(signal.SIGTERM)
        process.wait(15)
    assert "Traceback" not in server.output()
    assert "did not end" not in server.output(), "shutdown must not wait for a silent receiver"
    assert receiver.asked.count("PUT") == 1, "the archive was at the receiver already"
    for path, content in receiver.kept.items():
        assert hashlib.sha256(content).hexdigest()[:16] in path
        assert is_complete(content)
        assert b"Lakshmi" not in content


def is_complete(archive_bytes: bytes) -> bool:
    """Return whether every file of an archive matches its checksum."""
    with zipfile.ZipFile(io.BytesIO(archive_bytes)) as archive:
        files = {name.split("/")[1]: archive.read(name) for name in archive.namelist()}
    sums = dict(line.split("  ")[::-1] for line in files.pop("SHA256SUMS").decode().splitlines())
    assert (
        {"visit.json", "history.json", "R-centre-1.png", "R-centre-1-colour.png", "R-centre-1.json"}
        == files.keys()
        == sums.keys()
    )
    return all(hashlib.sha256(content).hexdigest() == sums[name] for name, content in files.items())


def test_invalid_upload_settings_are_refused_at_the_start(
    head_file: Path, diffuscope: Diffuscope, tmp_path: Path
) -> None:
    (tmp_path / "send.toml").write_text('address = "http://reader.example.org"\ntoken = "x"\n')
    result = diffuscope("run", "--head", head_file, "--send", tmp_path / "send.toml", "--data", tmp_path / "data")
    named = "send.toml, line 1: address: " in result.stderr
    assert (result.returncode, "https:// only" in result.stderr, named) == (2, True, True)
    assert not (tmp_path / "data").exists()
