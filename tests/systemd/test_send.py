"""Upload without a network: the instrument reaches the receiver through one socket, at one address."""

import base64
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.project_files import ROOT
from tests.receiver import KEY
from tests.site import identity
from tests.systemd.machine import UNIT, Machine, booted

pytestmark = pytest.mark.systemd

PORT = 8443
ASK = """
import json, sys, urllib.request as u
method, path, body = sys.argv[1:]
data = json.dumps(json.loads(body)).encode() if body else None
request = u.Request("http://127.0.0.1:8000" + path, data, {"Content-Type": "application/json"}, method=method)
print(u.urlopen(request, timeout=120).read().decode())
"""
RECEIVE = """
import sys, time
sys.path.insert(0, "/run/receiver")
from pathlib import Path
from receiver import receiving
with receiving(Path("/run/receiver/web.crt"), Path("/run/receiver/web.key"), 8443) as known:
    while True:
        time.sleep(0.2)
        Path("/run/receiver/kept").write_text("\\n".join(known.kept))
"""


def put(machine: Machine, path: str, content: str) -> None:
    machine.run("sh", "-c", f"echo {base64.b64encode(content.encode()).decode()} | base64 -d > {path}")


def ask(machine: Machine, method: str, path: str, body: dict[str, str] | None = None) -> dict[str, object]:
    answer: dict[str, object] = json.loads(
        machine.run("python3", "-c", ASK, method, path, json.dumps(body) if body else "")
    )
    return answer


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A device configured for uploads as systemd/README.md describes."""
    folder = tmp_path_factory.mktemp("machine")
    certificate, key = identity(folder)
    with booted(folder) as machine:
        machine.run("mkdir", "-p", "/run/receiver", "/etc/diffuscope")
        put(machine, "/run/receiver/receiver.py", (ROOT / "tests" / "receiver.py").read_text())
        put(machine, "/run/receiver/web.crt", certificate.read_text())
        put(machine, "/run/receiver/web.key", key.read_text())
        machine.run("systemd-run", "--unit=receiver", "python3", "-c", RECEIVE)
        put(machine, "/etc/diffuscope/send.env", SET_UP["send.env"])
        put(machine, "/etc/diffuscope/send.toml", SET_UP["send.toml"])
        put(machine, "/etc/diffuscope/send.token", KEY)
        machine.run("cp", "/run/receiver/web.crt", "/etc/diffuscope/send.crt")
        machine.run("chgrp", "diffuscope-send", "/etc/diffuscope/send.token")
        machine.run("chmod", "640", "/etc/diffuscope/send.token")
        machine.run("systemctl", "start", UNIT)
        yield machine


def sent(machine: Machine) -> int:
    time.sleep(1)  # each request starts a Python process beside the instrument
    known: dict[str, int] = ask(machine, "GET", "/api/status")["sending"]  # type: ignore[assignment]
    return known["sent"]


def lines(language: str) -> str:
    """Return an example of the README, with the receiver of this test."""
    text = (ROOT / "systemd" / "README.md").read_text()
    (found,) = re.findall(rf"```{language}\n(.*?)```", text, re.S)
    found = found.replace("reader.example.org:443", f"127.0.0.1:{PORT}")  # no name resolution in the container
    return found.replace("reader.example.org", f"localhost:{PORT}")


SET_UP = {"send.env": lines("ini"), "send.toml": lines("toml")}


def test_visit_is_uploaded_by_a_process_without_network(machine: Machine) -> None:
    machine.until(lambda: machine.show(UNIT, "ActiveState") == ["active"], 240)
    key = [f"{number:016x}" for number in range(4)]
    visit = str(ask(machine, "POST", "/api/visits", {"key": key[0]})["id"])
    consent = {"key": key[3], "field": "consent", "value": "agreed"}
    ask(machine, "PATCH", f"/api/visits/{visit}", consent)
    ask(machine, "POST", "/api/captures", {"eye": "OD", "slot": "R-centre", "visit": visit, "key": key[1]})
    ask(machine, "POST", f"/api/visits/{visit}/finish", {"key": key[2]})
    machine.until(lambda: visit in machine.run("cat", "/run/receiver/kept"), 90)
    machine.until(lambda: sent(machine) == 1, 30)
    links = machine.run("cat", f"/proc/{machine.main_pid()}/net/dev").splitlines()[2:]
    assert [link.split(":")[0].strip() for link in links] == ["lo"]


def test_upload_proxy_is_unprivileged_and_its_socket_is_protected(machine: Machine) -> None:
    pid = int(machine.show("diffuscope-send.service", "MainPID")[0])
    status = machine.run("cat", str(Path("/proc") / str(pid) / "status"))
    assert int(re.findall(r"^Uid:\s+(\d+)", status, re.M)[0]) > 60000
    assert re.findall(r"^(?:CapEff|NoNewPrivs|Seccomp):\s+(\S+)", status, re.M) == ["0000000000000000", "1", "2"]
    reach = "import socket; socket.socket(socket.AF_UNIX).connect('/run/diffuscope-send.socket')"
    stranger = ["setpriv", "--reuid=nobody", "--clear-groups", "python3", "-c", f"{reach}; print('in')"]
    assert machine.run(*stranger, check=False) == ""
    token = ["setpriv", "--reuid=nobody", "--clear-groups", "cat", "/etc/diffuscope/send.token"]
    assert machine.run(*token, check=False) == ""
