"""Sequence of updates: 1.0 to 2.0, then the broken 3.0 with rollback, without loss of a capture.

Everything inside is a release: the image of `systemd/image/bundle`, its units, RAUC, and `diffuscope update`.
"""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.appliance import releases
from tests.appliance.device import Device, factory_new
from tests.appliance.releases import BROKEN, IMPATIENT, Workshop
from tests.project_files import ROOT
from tests.systemd.machine import Machine

pytestmark = pytest.mark.systemd

PRECONDITIONS = "opt/diffuscope/services/update/preconditions.py"
HASTY = "EXAM_S = 600.0", "EXAM_S = 1.0"  # ten minutes after a picture are too long here
PYTHON = "/opt/diffuscope/.venv/bin/python"
DIFFUSCOPE = "/opt/diffuscope/.venv/bin/diffuscope"
PRESS = """\
import time, urllib.error, urllib.request as u
body = '{"eye": "OD"}'.encode()
press = u.Request("http://127.0.0.1:8000/api/captures", body, {"Content-Type": "application/json"})
for _ in range(20):  # a health check holds the camera until two seconds after its picture
    try:
        print(u.urlopen(press).status)
        break
    except urllib.error.HTTPError as refused:
        if refused.code != 409:
            raise
        time.sleep(1)
"""

# Without a user, whom the device's own screen does not need while its head is simulated.
TAP = """\
import json, sys, time, urllib.request as u

def ask(method, path, body=None):
    words = {"Content-Type": "application/json"}
    data = None if body is None else json.dumps(body).encode()
    return u.urlopen(u.Request("http://127.0.0.1:8000/api/" + path, data, words, method=method), timeout=60)

status = json.load(ask("GET", "update"))
if sys.argv[1] == "install":
    ask("POST", "update/check", {})
    end = time.monotonic() + 110
    while not status["looked"] or status["state"] in ("asked", "looking"):
        assert time.monotonic() < end, status
        time.sleep(0.2)
        status = json.load(ask("GET", "update"))
    ask("POST", "update/install", {"id": status["found"][0]["id"]})
print(json.dumps(status))
"""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return releases.opened(tmp_path_factory.mktemp("workshop"))


@pytest.fixture(scope="module")
def bundles(workshop: Workshop) -> dict[str, Path]:
    begin_s = time.monotonic()
    hasty = {PRECONDITIONS: (ROOT / "services" / "update" / "preconditions.py").read_text().replace(*HASTY)}
    broken = {"opt/diffuscope/services/http/server.py": BROKEN, "etc/diffuscope/update.toml": IMPATIENT}
    built = {name: workshop.bundle(name, hasty | files) for name, files in (("1.0", {}), ("2.0", {}), ("3.0", broken))}
    print(f"three releases built in {time.monotonic() - begin_s:.0f} s")  # noqa: T201  # figure for the log (-rP)
    return built


@pytest.fixture(scope="module")
def device(workshop: Workshop, bundles: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    with factory_new(tmp_path_factory.mktemp("device"), workshop.image(bundles["1.0"])) as device:
        yield device


def pause() -> bool:
    """Wait 0.5 s between requests, since the device is busy; return True."""
    time.sleep(0.5)
    return True


def wait_until_healthy(machine: Machine) -> None:
    """Poll the page until it is healthy, then run `diffuscope health` once."""
    asks = "import json, urllib.request as u; print(json.load(u.urlopen('http://127.0.0.1:8000/api/health'))['ok'])"
    machine.until(lambda: pause() and "True" in machine.run("python3", "-c", asks, check=False), 240)
    print(machine.run(DIFFUSCOPE, "health", "--look"))  # noqa: T201  # figure for the log (-rP)


def wait_for_state(device: Device, machine: Machine, state: str) -> None:
    """Wait until the journal on the data partition has this state."""
    path = device.data / "update" / "journal.json"
    end_s = time.monotonic() + 300
    while pause() and json.loads(path.read_text())["state"] != state:
        assert time.monotonic() < end_s, device.journal_tail()
        assert machine.is_on(), device.journal_tail()


def insert_drive(device: Device, bundle: Path) -> None:
    """Put one update on the USB drive."""
    stick = device.folder / "media" / "stick"
    shutil.rmtree(stick, ignore_errors=True)
    stick.mkdir()
    shutil.copy(bundle, stick)


def update(device: Device, machine: Machine) -> None:
    """Install the update on the USB drive; the device then restarts by itself."""
    begin_s = time.monotonic()
    machine.run("systemd-run", "--quiet", "--no-block", "--unit=technician", DIFFUSCOPE, "update", "install")
    device.restarts(machine)
    print(f"installed and restarted in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # figure for the log (-rP)


def update_from_the_page(device: Device, machine: Machine) -> dict[str, Any]:
    """Install from the technician's page, whose process is unprivileged; return the status with the updates found."""
    begin_s = time.monotonic()
    status = json.loads(machine.run("python3", "-c", TAP, "install"))
    device.restarts(machine)
    print(f"tapped, found, installed and restarted in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # figure for the log (-rP)
    return dict(status)


def page_status(machine: Machine) -> dict[str, Any]:
    """Return the status that the update screen shows."""
    return dict(json.loads(machine.run("python3", "-c", TAP, "look")))


def status(machine: Machine) -> str:
    return machine.run(DIFFUSCOPE, "update", "status")


def check_rauc_access(machine: Machine) -> None:
    """Check that only root may call RAUC over D-Bus; Debian's default policy allows everyone."""
    asks = ["busctl", "get-property", "de.pengutronix.rauc", "/", "de.pengutronix.rauc.Installer", "Operation"]
    assert "idle" in machine.run(*asks)
    assert "idle" not in machine.run("runuser", "-u", "nobody", "--", *asks, check=False)


def identity_files(device: Device) -> dict[str, bytes]:
    """Return the files of the identity; check that all boots wrote one journal under its machine id."""
    files = {path.name: path.read_bytes() for path in (device.data / "identity").iterdir()}
    assert [path.name for path in (device.data / "journal").iterdir()] == [files["machine-id"].decode()]
    return files


def test_update_is_committed_by_the_new_versions_health_checks(device: Device, bundles: dict[str, Path]) -> None:
    insert_drive(device, bundles["2.0"])
    with device.on() as machine:
        wait_until_healthy(machine)
        assert [machine.run(PYTHON, "-c", PRESS).strip() for _ in range(2)] == ["201", "201"]
        kept = device.captures()
        assert len({name.split("/")[1] for name in kept}) == 2
        identity = identity_files(device)
        assert (page_status(machine)["here"], page_status(machine)["runs"]) == (True, "1.0")
        time.sleep(1.0)
        (found,) = update_from_the_page(device, machine)["found"]
        assert (found["where"], found["stick"], found["version"], found["trouble"]) == ("stick", "stick", "2.0", None)
    assert (device.tried, device.autoboot()) == (True, ("A", "B"))
    with device.on() as machine:
        begin_s = time.monotonic()
        assert device.booted == "B"
        wait_for_state(device, machine, "committed")
        print(f"2.0 committed {time.monotonic() - begin_s:.0f} s after its boot")  # noqa: T201  # figure for the log (-rP)
        assert device.autoboot() == ("B", "A")
        assert "Updated to 2.0" in status(machine)
        screen = page_status(machine)
        assert (screen["state"], screen["runs"], screen["trouble"]) == ("committed", "2.0", None)
        assert screen["news"]
        check_rauc_access(machine)
        about = "/usr/share/diffuscope"
        assert json.loads(machine.run("cat", f"{about}/release.json"))["version"] == "2.0"
        inside = {part["name"] for part in json.loads(machine.run("cat", f"{about}/sbom.cdx.json"))["components"]}
        assert {"numpy", "systemd", "rauc", "fastapi"} <= inside
    assert device.captures() == kept
    assert identity_files(device) == identity


def test_broken_version_is_rolled_back_and_every_capture_stays(device: Device, bundles: dict[str, Path]) -> None:
    kept = device.captures()
    assert kept
    insert_drive(device, bundles["3.0"])
    with device.on() as machine:
        assert device.booted == "B"  # committed
        wait_until_healthy(machine)
        update(device, machine)
    with device.on() as machine:
        assert device.booted == "A"
        assert "Version 3.0 is being tried" in status(machine)
        insert_drive(device, bundles["2.0"])
        output = machine.run("sh", "-c", f"{DIFFUSCOPE} update install 2>&1", check=False)
        assert "the committed one" in output  # RAUC itself refuses it too
        shutil.copy(bundles["2.0"], device.data / "update" / "by-hand.raucb")
        by_hand = machine.run("sh", "-c", "rauc install /var/lib/diffuscope-update/by-hand.raucb 2>&1", check=False)
        assert "failed" in by_hand, by_hand
        device.restarts(machine)
    assert device.autoboot() == ("B", "A")
    assert not device.tried
    with device.on() as machine:
        assert device.booted == "B"
        output = status(machine)
        assert (
            "Version 2.0 runs. Version 3.0 was tried and was not well, so 2.0 is back: page: does not answer" in output
        )
        wait_until_healthy(machine)
        screen = page_status(machine)
        assert (screen["state"], screen["version"], screen["trouble"]["code"]) == ("went back", "3.0", "update.failed")
        assert machine.run(PYTHON, "-c", PRESS).strip() == "201"
    assert {name: digest for name, digest in device.captures().items() if name in kept} == kept
