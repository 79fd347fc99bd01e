"""A client without a login on another host reads, changes, lights and blocks nothing (network namespace; needs root).

The server has three sockets as on the device: the page for this computer, the page by TLS and pairing for the network.
`python -m pytest -s tests/hard/test_anonymous_client.py` prints the answers.
"""

import hashlib
import re
import secrets
import shutil
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from itertools import product
from pathlib import Path
from typing import Any

import httpx
import pytest

from device.clock import SystemClock
from services.errors import UpdateDuringExam
from services.http.access import OPERATIONS
from services.identity.certificates import create_authority, create_server_certificate
from services.update.preconditions import EXAM_S, refuse_while_in_use
from tests.browser.conftest import copy_small_plans, free_port
from tests.hard.anonymous_client import FORMS, Asked, Report, Target
from tests.network_namespace import HERE, IN_SPACE, missing, namespace
from tests.project_files import ROOT
from tests.signed_in_server import signed_in_server
from tests.simulated import small_head_toml
from tests.store_damage import PIN, filled_store

REASON = missing()
pytestmark = pytest.mark.skipif(REASON != "", reason=REASON)
SERVER = """
import os, socket, sys
addresses = zip(sys.argv[1:4], map(int, sys.argv[4:7]))
made = [socket.create_server(address) for address in addresses]
assert [one.detach() for one in made] == [3, 4, 5]
[os.set_inheritable(number, True) for number in (3, 4, 5)]
names = ":".join(f"diffuscope{part}.socket" for part in ("", "-network", "-pairing"))
os.environ |= {"LISTEN_PID": str(os.getpid()), "LISTEN_FDS": "3", "LISTEN_FDNAMES": names}
os.execv(sys.executable, [sys.executable, "-m", "services", "run", *sys.argv[7:]])
"""
OWN_WORK = {"audit-log.jsonl", "audit-head.json", "access/lock-out.json", "reserve.bin"}
PUBLIC = {operation for operation, (access, _) in OPERATIONS.items() if access.from_anywhere}
MAX_SLOWER_S = 5.0  # a press of the small head takes 1 s


class Device:
    """The server, with a client at its own screen."""

    def __init__(self, folder: Path, ports: tuple[int, int, int], own: httpx.Client, authority: str) -> None:
        self.data, self.ports, self.own, self.authority = folder / "data", ports, own, authority

    def digest(self) -> dict[str, str]:
        """Return digests of the rows of each table, and of each file of the store but what each request adds to."""
        with closing(sqlite3.connect(f"file:{self.data}/store.sqlite?mode=ro", uri=True)) as database:
            tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            found = {name: repr(database.execute(f"SELECT * FROM {name}").fetchall()).encode() for name in tables}
        names = [str(path.relative_to(self.data)) for path in self.data.rglob("*") if path.is_file()]
        kept = {name for name in names if not name.startswith(("store.sqlite", "event-log/"))} - OWN_WORK
        found |= {name: (self.data / name).read_bytes() for name in kept}
        return {name: hashlib.sha256(content).hexdigest() for name, content in found.items()}

    def status_of(self, asked: Asked) -> int:
        """Send a request as the user of the own screen, on a connection of its own, and return the status."""
        headers = {"Cookie": f"login={self.own.cookies['login']}", "X-Controller": "0" * 16}
        at = f"http://127.0.0.1:{self.ports[0]}{asked.path}"
        return httpx.request(asked.method, at, json=asked.body, headers=headers, timeout=60).status_code

    def press(self) -> float:
        """Take a picture at the own screen and return its time in s."""
        begun_s = time.monotonic()
        assert self.own.post("/api/captures", json={"eye": "OD"}).status_code == 201
        return time.monotonic() - begun_s


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    folder = tmp_path_factory.mktemp("device")
    filled_store(folder, with_log=False).rename(folder / "data")
    shutil.rmtree(folder / "data/calibrations")
    copy_small_plans(folder / "data")
    (folder / "head.toml").write_text(small_head_toml("Small simulated head", summed=2))
    authority, tls = create_authority("eye", SystemClock()), folder / "data/tls"
    tls.mkdir()
    leaf = create_server_certificate(*authority[:2], "eye", SystemClock(), [ip_address(HERE)])
    files = {"authority.crt": authority[1], "authority-unconstrained.crt": authority[2], "server.pem": leaf}
    for name, content in files.items():
        (tls / name).write_bytes(content)
    with namespace(), running(folder, authority[1].decode()) as device:
        yield device


@contextmanager
def running(folder: Path, authority: str) -> Iterator[Device]:
    """Run the server with its three sockets."""
    ports = free_port(), free_port(), free_port()
    words = ["127.0.0.1", HERE, HERE, *map(str, ports), "--head", str(folder / "head.toml")]
    command = [sys.executable, "-c", SERVER, *words, "--data", str(folder / "data")]
    with signed_in_server(command, folder / "log", ports[0]) as own:
        yield Device(folder, ports, own, authority)


def plausible(document: dict[str, Any], records: dict[str, str]) -> list[Asked]:
    """Return every operation of the document with the ids of records that exist, and a body of its schema."""
    found = []
    for path, verbs in document["paths"].items():
        kind = "visit" if "/visits/" in path else "capture"
        named = {"id": records[kind], "name": "Ravi" if "/users/" in path else "picture.png", "eye": "OD"}
        for verb, operation in verbs.items():
            query = [one["name"] for one in operation.get("parameters", []) if one["in"] == "query"]
            values = {"number": records["number"], "method": "gradient", "visit": records["visit"], "eye": "OD"}
            asked = "&".join(f"{name}={values[name]}" for name in query if name in values)
            content = operation.get("requestBody", {}).get("content", {}).get("application/json")
            body = None if content is None else body_of(document, content["schema"]["$ref"], records)
            at = path.format_map(named)
            found.append(Asked(method=verb.upper(), path=f"{at}?{asked}" if asked else at, body=body))
    return sorted(found, key=lambda one: one.method == "DELETE")  # the end of the login and the user come last


def body_of(document: dict[str, Any], reference: str, records: dict[str, str]) -> dict[str, Any]:
    """Return a body with a value for each required field, and for those of a visit."""
    values = {
        "visit": records["visit"],
        "capture": records["capture"],
        "number": records["number"],
        "slot": "R-centre",
        "field": "vision_od",
        "value": "6/60",
        "name": "Asha",
        "secret": "111222",
        "new": "918274",
        "code": "WRONG",
        "roles": ["administrator"],
        "reason": "mistake",
        "fingerprint": "SHA256:other",
        "confirmed": True,
        "now": "2059-01-01T00:00:00Z",
        "by": "Eve",
        "stand": "dark",
        "folder": "/media/x",
        "passphrase": "a blue boat in May",
        "id": "0" * 16,
        "lens": 0,
        "take": True,
    }
    schema = document["components"]["schemas"][reference.rpartition("/")[2]]
    wanted = {*schema.get("required", []), *({"visit", "slot", "take", "roles"} & set(schema["properties"]))}
    fixed = {name: kind["enum"][0] for name, kind in schema["properties"].items() if "enum" in kind}
    return {name: secrets.token_hex(8) if name == "key" else (values | fixed)[name] for name in sorted(wanted)}


def statics(own: httpx.Client) -> list[Asked]:
    """Return the pages and all files that they name."""
    paths = {
        "/",
        "/technician",
        "/api/openapi.json",
        "/authority.crt",
        "/server.pem",
        "/tls/server.pem",
        "/store.sqlite",
    }
    for page in ("/", "/technician"):
        paths |= set(re.findall(r'(?:src|href)="(/[^"]+)"', own.get(page).text))
    return [Asked(method=method, path=path) for path, method in product(sorted(paths), ("GET", "HEAD", "POST"))]


def secrets_of(own: httpx.Client) -> tuple[list[bytes], dict[str, str]]:
    """Return names, numbers and pieces of pictures that the device shows to its user, and ids of a visit's records."""
    visits = [own.get(f"/api/visits/{one['id']}").json() for one in own.get("/api/visits").json()["visits"]]
    texts = [text for visit in visits for text in (visit["number"], visit["fields"]["name"])]
    captures = own.get("/api/captures").json()["captures"]
    files = [own.get(f"/api/captures/{captures[0]['id']}/{name}").content for name in ("picture.png", "raw.tiff")]
    open_visit = next(one for one in visits if not one["finished_at"])
    of_visit = next(one["id"] for one in captures if one["report"]["visit"] == open_visit["id"])
    records = {"visit": open_visit["id"], "capture": of_visit, "number": open_visit["number"]}
    return [*map(str.encode, texts), *(content[len(content) // 2 :][:24] for content in files)], records


@pytest.mark.timeout(600)  # two thousand requests, and a few pictures
def test_a_client_without_a_login_on_another_host_reads_changes_lights_and_blocks_nothing(device: Device) -> None:
    device.press()
    own, here = device.own, f"http://127.0.0.1:{device.ports[0]}"
    ravi = {"name": "Ravi", "secret": PIN, "roles": ["reader"]}
    hidden, records = secrets_of(own)
    for path, body in (("/api/users", ravi), ("/api/visits", {"key": "f" * 16})):
        assert own.post(path, json=body).status_code == 201
    assert len(hidden) >= 10
    asked = plausible(own.get("/api/openapi.json").json(), records)
    page, tls, pairing = device.ports
    target = Target(
        address=HERE,
        tls_port=tls,
        pairing_port=pairing,
        own_port=page,
        authority=device.authority,
        requests=asked + statics(own),
        secret_hex=[one.hex() for one in hidden],
    )
    before = device.digest()
    words = [*IN_SPACE, sys.executable, "-m", "tests.hard.anonymous_client"]
    with subprocess.Popen(words, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as anonymous:
        assert anonymous.stdin is not None
        assert anonymous.stdout is not None
        anonymous.stdin.write(target.model_dump_json() + "\n")
        anonymous.stdin.flush()
        assert anonymous.stdout.readline() == "blocking\n"
        assert device.digest() == before, "no row, file or dose changed"
        now = datetime.now(UTC)
        refuse_while_in_use(here, 0.5, now + timedelta(seconds=2 * EXAM_S))  # after the first press; a visit is open
        assert own.post("/api/login", json={"name": "Asha", "secret": PIN}).status_code == 200, (
            "guesses are no wait here"
        )
        status_s, press_s = timed(device, "/api/status"), device.press()
        with pytest.raises(UpdateDuringExam):
            refuse_while_in_use(here, 0.5, now)
        report = Report.model_validate_json(anonymous.communicate("done\n", timeout=60)[0])
    for form, counts in report.answers.items():
        sys.stdout.write(f"{form}: {sum(counts.values())} {dict(sorted(counts.items()))}\n")
    sys.stdout.write(f"own screen meanwhile: status {status_s:.2f} s, press {press_s:.2f} s\n")
    assert max(status_s, press_s) < MAX_SLOWER_S
    assert report.disclosed == []
    assert set(report.answers) >= {*FORMS, "guesses", "visits", "connections"}
    assert not [one for one in report.succeeded if not is_public(one)]
    assert {status for counts in report.answers.values() for status in counts if status.startswith("5")} <= {"503"}
    as_user = Counter(device.status_of(one) for one in asked if is_of_control(one))
    sys.stdout.write(f"the same requests of a user: {dict(sorted(as_user.items()))}\n")
    assert as_user[401] + as_user[422] < as_user.total() / 10, "the bodies are plausible"
    changed = {name for name, digest in device.digest().items() if before.get(name) != digest}
    assert {"visits", "captures", "dose-ledger.log", "access/users.json"} <= changed, "the digest shows changes"


def is_of_control(asked: Asked) -> bool:
    """Return whether a request is one of the control: no stream, no other holder of the lease, no end of the login."""
    others = [("GET", "/api/events"), ("POST", "/api/controller"), ("DELETE", "/api/login")]
    return (asked.method, asked.path) not in others


def timed(device: Device, path: str) -> float:
    """Return the time in s of one request of the own screen."""
    begun_s = time.monotonic()
    assert device.own.get(path).status_code == 200
    return time.monotonic() - begun_s


def is_public(line: str) -> bool:
    """Return whether a request that succeeded is one for a page, a file of a page, an authority, or needs no login."""
    method, path = line.partition(": ")[2].split()
    files = path.startswith("/web/") or path in ("/authority.crt", "/technician", "/")
    return (files and method in ("GET", "HEAD")) or f"{method} {path}" in PUBLIC
