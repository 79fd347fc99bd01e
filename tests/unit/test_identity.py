"""Identity of a device: created once, atomically, unique, and applied at every boot."""

import re
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from device.clock import SystemClock, VirtualClock
from services.errors import StoreDamaged
from services.identity.apply_at_boot import Computer
from services.identity.provision import FILES, Identity, device_name, load_or_create_identity
from tests.project_files import ROOT

SERIAL = "10000000a1b2c3d4"
BORN = """\
import sys
from pathlib import Path
from device.clock import SystemClock
from services.identity.provision import load_or_create_identity
print("ready", flush=True)
load_or_create_identity(Path(sys.argv[1]), sys.argv[2], SystemClock())
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    """Root file system of a release, on a board with a serial number in its device tree."""
    for name in ("proc/device-tree", "etc/diffuscope", "data"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "proc/device-tree/serial-number").write_text(f"{SERIAL.upper()}\0")
    shutil.copy(ROOT / "systemd/image/access-point.nmconnection", tmp_path / "etc/diffuscope")
    return Computer(tmp_path)


def test_identity_is_created_once_and_then_read(tmp_path: Path) -> None:
    first = load_or_create_identity(tmp_path / "data/identity", SERIAL, VirtualClock())
    stored = contents(tmp_path / "data/identity")
    assert set(stored) == set(FILES)
    assert load_or_create_identity(tmp_path / "data/identity", "ffffffffffffffff", VirtualClock()) == first
    assert contents(tmp_path / "data/identity") == stored
    assert first.name == "diffuscope-b2c3d4"
    assert stat.S_IMODE((tmp_path / "data/identity").stat().st_mode) == 0o700


def test_two_devices_share_no_secret(tmp_path: Path) -> None:
    left, right = (load_or_create_identity(tmp_path / name, SERIAL, VirtualClock()) for name in ("one", "other"))
    assert left.wifi != right.wifi
    assert left.machine_id != right.machine_id
    assert left.authority_key != right.authority_key
    assert re.fullmatch(r"([a-hjkmnp-z2-9]{4}-){3}[a-hjkmnp-z2-9]{4}", left.wifi)


def test_interrupted_first_boot_is_completed_by_the_next(tmp_path: Path) -> None:
    """Kill at twelve moments between the first write and after the last: no identity, or a complete one."""
    found, takes_s = [], 0.0
    for cut in range(-1, 12):
        folder = tmp_path / str(cut) / "identity"
        words = [sys.executable, "-c", BORN, folder, SERIAL]
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            begin_s = time.monotonic()
            if cut < 0:  # the first one is not killed, to measure its duration
                process.wait()
                takes_s = time.monotonic() - begin_s
            time.sleep(takes_s * cut / 10 if cut > 0 else 0)
            process.kill()
        whole = contents(folder) if folder.exists() else None
        found.append(whole is not None)
        made = load_or_create_identity(folder, SERIAL, SystemClock())
        assert made == load_or_create_identity(folder, SERIAL, SystemClock())
        assert [path.name for path in folder.parent.iterdir()] == ["identity"], "the unfinished folder is removed"
        if whole is not None:
            assert contents(folder) == whole, "a complete identity is not replaced"
    print(f"{sum(found)} of {len(found)} were complete when killed")  # noqa: T201


def test_damaged_identity_is_an_error_and_is_not_replaced(tmp_path: Path) -> None:
    """Tablets trust the identity and its label is printed, so a silent replacement would lock them out."""
    folder = tmp_path / "identity"
    load_or_create_identity(folder, SERIAL, VirtualClock())
    for name in ("wifi", "machine-id"):
        whole = (folder / name).read_bytes()
        for damaged in (b"", whole[:-1], b"\0" * len(whole)):
            (folder / name).write_bytes(damaged)
            with pytest.raises(StoreDamaged, match=name):
                load_or_create_identity(folder, SERIAL, VirtualClock())
            assert (folder / name).read_bytes() == damaged
        (folder / name).write_bytes(whole)
    (folder / "authority.key").unlink()
    with pytest.raises(StoreDamaged, match=r"authority\.key") as caught:
        load_or_create_identity(folder, SERIAL, VirtualClock())
    assert "new label" in caught.value.remedy


def test_every_boot_writes_the_same_identity(computer: Computer) -> None:
    for _ in range(2):  # the second boot starts from a volatile root
        identity = load_or_create_identity(computer.data / "identity", computer.serial(), VirtualClock())
        shutil.rmtree(computer.root / "run", ignore_errors=True)
        computer.apply_identity(identity)
        assert (computer.root / "etc/hostname").read_text() == "diffuscope-b2c3d4\n"
        access_point = computer.root / "run/NetworkManager/system-connections/access-point.nmconnection"
        assert "ssid=diffuscope-b2c3d4\nband" in access_point.read_text()
        assert f"psk={identity.wifi}\n" in access_point.read_text()
        assert "@" not in access_point.read_text()
        secret = [path for path in (computer.root / "run").rglob("*") if path.is_file()]
        assert len(secret) == 2
        assert {stat.S_IMODE(path.stat().st_mode) for path in secret} == {0o600}


@pytest.mark.skipif(None in (shutil.which("agetty"), shutil.which("script")), reason="agetty is not installed")
def test_screen_shows_the_address_on_each_network_and_nothing_without(computer: Computer) -> None:
    """A wrong Wi-Fi password has no other sign: the label as agetty shows it, with one interface of this machine."""
    applied_identity(computer)
    label = (computer.root / "run/issue.d/diffuscope.issue").read_text()
    assert label.endswith("Address by Wi-Fi: \\4{wlan0}   by cable: \\4{eth0}\\4{end0}\n\n")
    here = computer.root / "issue"
    here.write_text(label.replace("wlan0", "lo").replace("eth0", "none0").replace("end0", "none1"))
    words = ["script", "-qec", f"agetty --show-issue --issue-file {here}", "/dev/null"]
    shown = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "Address by Wi-Fi: 127.0.0.1   by cable: \n" in shown
    assert f"Wi-Fi {device_name(SERIAL)}   password" in shown


def test_board_without_serial_number_keeps_its_random_one(computer: Computer) -> None:
    (computer.root / "proc/device-tree/serial-number").unlink()
    first = load_or_create_identity(computer.data / "identity", computer.serial(), VirtualClock())
    assert load_or_create_identity(computer.data / "identity", computer.serial(), VirtualClock()) == first
    assert re.fullmatch("diffuscope-[0-9a-f]{6}", first.name)


def applied_identity(computer: Computer) -> Identity:
    identity = load_or_create_identity(computer.data / "identity", computer.serial(), VirtualClock())
    computer.apply_identity(identity)
    return identity
