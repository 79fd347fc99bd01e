"""A finished visit gets to a receiver over HTTPS, from `diffuscope run --send`: once and whole, whatever is killed."""

import hashlib
import io
import json
import signal
import time
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
    with receiving(*identity(tmp_path)) as known:
        said = known.settings(tmp_path, authority=tmp_path / "web.crt")
        (tmp_path / "send.toml").write_text(
            "".join(f"{name} = {json.dumps(said[name], default=str)}\n" for name in said)
        )
        yield known


def finished(server: Server, first: int) -> str:
    """One more visit of one picture, finished."""
    key = [f"{number:016x}" for number in range(first, first + 5)]
    visit: str = server.ask("POST", "/api/visits", {"key": key[0]})["id"]
    server.ask("PATCH", f"/api/visits/{visit}", {"key": key[1], "field": "name", "value": "Lakshmi Narayanan"})
    server.ask("PATCH", f"/api/visits/{visit}", {"key": key[2], "field": "consent", "value": "agreed"})
    server.ask("POST", "/api/captures", {"eye": "OD", "slot": "R-centre", "visit": visit, "key": key[3]})
    server.ask("POST", f"/api/visits/{visit}/finish", {"key": key[4]})
    return visit


def sending(server: Server) -> dict[str, int]:
    said: dict[str, int] = server.ask("GET", "/api/status")["sending"]
    return said


def test_each_visit_arrives_once_and_whole_also_when_the_sender_is_killed_before_it_knows(
    receiver: Receiver, head_file: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    server = Server(head_file, tmp_path / "data", environment, "--send", str(tmp_path / "send.toml"))
    with server.running() as process:
        until(lambda: server.ask("GET", "/api/status")["state"] == "aim", 120)
        finished(server, 0)
        until(lambda: sending(server) == {"sent": 1, "waiting": 0}, 60)
        receiver.asked.clear()
        receiver.after_put.clear()  # the next one is kept, and nobody can be asked about it
        finished(server, 16)
        until(lambda: receiver.asked == ["HEAD", "PUT", "HEAD"], 60)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert len(receiver.kept) == 2
    receiver.after_put.set()
    with server.running() as process:
        until(lambda: sending(server) == {"sent": 2, "waiting": 0}, 60)
        assert server.ask("GET", "/api/outbox")["visits"] == []
        receiver.gate.clear()
        finished(server, 32)
        until(lambda: receiver.asked[-2:] == ["HEAD", "HEAD"], 60)
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        process.wait(15)
        assert time.monotonic() - begin < 5, "nobody who switches it off waits for a receiver that is silent"
    assert "Traceback" not in server.said()
    assert receiver.asked.count("PUT") == 1, "it was there already"
    for path, content in receiver.kept.items():
        assert hashlib.sha256(content).hexdigest()[:16] in path
        assert whole(content)
        assert b"Lakshmi" not in content


def whole(parcel: bytes) -> bool:
    """Every file of it is as its checksums say."""
    with zipfile.ZipFile(io.BytesIO(parcel)) as archive:
        files = {name.split("/")[1]: archive.read(name) for name in archive.namelist()}
    sums = dict(line.split("  ")[::-1] for line in files.pop("SHA256SUMS").decode().splitlines())
    assert {"visit.json", "R-centre-1.png", "R-centre-1.json"} == files.keys() == sums.keys()
    return all(hashlib.sha256(content).hexdigest() == sums[name] for name, content in files.items())


def test_settings_that_cannot_be_are_refused_before_anything_is_opened(
    head_file: Path, diffuscope: Diffuscope, tmp_path: Path
) -> None:
    (tmp_path / "send.toml").write_text('address = "http://reader.example.org"\ntoken = "x"\n')
    told = diffuscope("run", "--head", head_file, "--send", tmp_path / "send.toml", "--data", tmp_path / "data")
    assert (told.returncode, "https:// only" in told.stderr, "--send" in told.stderr) == (2, True, True)
    assert not (tmp_path / "data").exists()
