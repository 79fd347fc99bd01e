"""A device's life: 1.0 becomes 2.0, the broken 3.0 is tried and taken back, and no capture is lost on the way.

Everything inside is what ships: the image of `systemd/image/bundle`, its units, RAUC, and `diffuscope update`.
"""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.appliance import releases
from tests.appliance.device import Device, made
from tests.appliance.releases import BROKEN, IMPATIENT, Workshop
from tests.systemd.machine import Machine

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(600)]

PYTHON = "/opt/diffuscope/.venv/bin/python"
DIFFUSCOPE = "/opt/diffuscope/.venv/bin/diffuscope"
PRESS = """\
import urllib.request as u
body = '{"eye": "OD"}'.encode()
print(u.urlopen(u.Request("http://127.0.0.1:8000/api/captures", body, {"Content-Type": "application/json"})).status)
"""

TAP = """\
import json, sys, time, urllib.request as u

def ask(method, path, body=None, cookie=""):
    words = {"Content-Type": "application/json", "Cookie": cookie}
    data = None if body is None else json.dumps(body).encode()
    return u.urlopen(u.Request("http://127.0.0.1:8000/api/" + path, data, words, method=method), timeout=60)

door = "unlock" if json.load(ask("GET", "technician"))["has_pin"] else "pin"
cookie = ask("POST", "technician/" + door, {"pin": "2580"}).headers["Set-Cookie"].split(";")[0]
told = json.load(ask("GET", "update", cookie=cookie))
if sys.argv[1] == "install":
    ask("POST", "update/check", {}, cookie)
    end = time.monotonic() + 110
    while not told["looked"] or told["state"] in ("asked", "looking"):
        assert time.monotonic() < end, told
        time.sleep(0.2)
        told = json.load(ask("GET", "update", cookie=cookie))
    ask("POST", "update/install", {"id": told["found"][0]["id"]}, cookie)
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return releases.opened(tmp_path_factory.mktemp("workshop"))


@pytest.fixture(scope="module")
def bundles(workshop: Workshop) -> dict[str, Path]:
    begin_s = time.monotonic()
    broken = {"opt/diffuscope/services/instrument/serve.py": BROKEN, "etc/diffuscope/update.toml": IMPATIENT}
    built = {"1.0": workshop.bundle("1.0"), "2.0": workshop.bundle("2.0"), "3.0": workshop.bundle("3.0", broken)}
    print(f"three releases built in {time.monotonic() - begin_s:.0f} s")  # noqa: T201  # a figure for who reads the log (-rP)
    return built


@pytest.fixture(scope="module")
def device(workshop: Workshop, bundles: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    with made(tmp_path_factory.mktemp("device"), workshop.image(bundles["1.0"])) as device:
        yield device


def slowly() -> bool:
    """A question every half second: the device has better things to do than to answer."""
    time.sleep(0.5)
    return True


def until_well(machine: Machine) -> None:
    """Wait by asking the page, which is cheap; then let the command judge, once."""
    asks = "import json, urllib.request as u; print(json.load(u.urlopen('http://127.0.0.1:8000/api/health'))['ok'])"
    machine.until(lambda: slowly() and "True" in machine.run("python3", "-c", asks, check=False), 240)
    print(machine.run(DIFFUSCOPE, "health", "--look"))  # noqa: T201  # a figure for who reads the log (-rP)


def until_settled(device: Device, machine: Machine, state: str) -> None:
    """Wait for the journal on the data partition to say so."""
    path = device.data / "update" / "journal.json"
    end_s = time.monotonic() + 300
    while slowly() and json.loads(path.read_text())["state"] != state:
        assert time.monotonic() < end_s, device.diary()
        assert machine.is_on(), device.diary()


def put_in(device: Device, bundle: Path) -> None:
    """A stick with one update, and no other."""
    stick = device.folder / "media" / "stick"
    shutil.rmtree(stick, ignore_errors=True)
    stick.mkdir()
    shutil.copy(bundle, stick)


def update(device: Device, machine: Machine) -> None:
    """Install what is on the stick; the device then restarts by itself."""
    begin_s = time.monotonic()
    machine.run("systemd-run", "--quiet", "--no-block", "--unit=technician", DIFFUSCOPE, "update", "install")
    device.restarts(machine)
    print(f"installed and restarted in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # a figure for who reads the log (-rP)


def tapped(device: Device, machine: Machine) -> dict[str, Any]:
    """The same by the technician's page, whose process has no rights: what it found on the stick."""
    begin_s = time.monotonic()
    told = json.loads(machine.run("python3", "-c", TAP, "install"))
    device.restarts(machine)
    print(f"tapped, found, installed and restarted in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # a figure for who reads the log (-rP)
    return dict(told)


def shown(machine: Machine) -> dict[str, Any]:
    """What the update screen shows."""
    return dict(json.loads(machine.run("python3", "-c", TAP, "look")))


def status(machine: Machine) -> str:
    return machine.run(DIFFUSCOPE, "update", "status")


def only_root(machine: Machine) -> None:
    """May talk to RAUC: Debian's own rules let everybody install."""
    asks = ["busctl", "get-property", "de.pengutronix.rauc", "/", "de.pengutronix.rauc.Installer", "Operation"]
    assert "idle" in machine.run(*asks)
    assert "idle" not in machine.run("runuser", "-u", "nobody", "--", *asks, check=False)


def who_it_is(device: Device) -> dict[str, bytes]:
    """The identity that the device made of itself; and all boots so far wrote one journal, under its number."""
    files = {path.name: path.read_bytes() for path in (device.data / "identity").iterdir()}
    assert [path.name for path in (device.data / "journal").iterdir()] == [files["machine-id"].decode()]
    return files


def test_version_1_becomes_2_and_is_committed_by_its_own_health(device: Device, bundles: dict[str, Path]) -> None:
    put_in(device, bundles["2.0"])
    with device.on() as machine:
        until_well(machine)
        assert [machine.run(PYTHON, "-c", PRESS).strip() for _ in range(2)] == ["201", "201"]
        kept = device.captures()
        assert len({name.split("/")[1] for name in kept}) == 2
        who = who_it_is(device)
        assert (shown(machine)["here"], shown(machine)["runs"]) == (True, "1.0")
        (found,) = tapped(device, machine)["found"]
        assert (found["where"], found["stick"], found["version"], found["trouble"]) == ("stick", "stick", "2.0", None)
    assert (device.tried, device.autoboot()) == (True, ("A", "B"))
    with device.on() as machine:
        begin_s = time.monotonic()
        assert device.booted == "B"
        until_settled(device, machine, "committed")
        print(f"2.0 committed {time.monotonic() - begin_s:.0f} s after its boot")  # noqa: T201  # a figure for who reads the log (-rP)
        assert device.autoboot() == ("B", "A")
        assert "Updated to 2.0" in status(machine)
        told = shown(machine)
        assert (told["state"], told["runs"], told["trouble"]) == ("committed", "2.0", None)
        assert told["news"]
        only_root(machine)
        about = "/usr/share/diffuscope"
        assert json.loads(machine.run("cat", f"{about}/release.json"))["version"] == "2.0"
        inside = {part["name"] for part in json.loads(machine.run("cat", f"{about}/sbom.cdx.json"))["components"]}
        assert {"numpy", "systemd", "rauc", "fastapi"} <= inside
    assert device.captures() == kept
    assert who_it_is(device) == who


def test_version_3_is_broken_is_tried_and_taken_back_with_every_capture(
    device: Device, bundles: dict[str, Path]
) -> None:
    kept = device.captures()
    assert kept
    put_in(device, bundles["3.0"])
    with device.on() as machine:
        assert device.booted == "B"  # by itself, from now on
        until_well(machine)
        update(device, machine)
    with device.on() as machine:
        assert device.booted == "A"
        assert "Version 3.0 is being tried" in status(machine)
        put_in(device, bundles["2.0"])
        said = machine.run("sh", "-c", f"{DIFFUSCOPE} update install 2>&1", check=False)
        assert "the committed one" in said  # and it cannot be forced by asking RAUC itself either
        shutil.copy(bundles["2.0"], device.data / "update" / "by-hand.raucb")
        by_hand = machine.run("sh", "-c", "rauc install /var/lib/diffuscope-update/by-hand.raucb 2>&1", check=False)
        assert "failed" in by_hand, by_hand
        device.restarts(machine)
    assert device.autoboot() == ("B", "A")
    assert not device.tried
    with device.on() as machine:
        assert device.booted == "B"
        said = status(machine)
        assert "Version 2.0 runs. Version 3.0 was tried and was not well, so 2.0 is back: page: does not answer" in said
        until_well(machine)
        told = shown(machine)
        assert (told["state"], told["version"], told["trouble"]["code"]) == ("went back", "3.0", "update.failed")
        assert machine.run(PYTHON, "-c", PRESS).strip() == "201"
    assert {name: digest for name, digest in device.captures().items() if name in kept} == kept
