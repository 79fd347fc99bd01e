"""Who a device is: made once, whole or not at all, unlike any other, and laid out again by every boot."""

import re
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from device.clock import SystemClock, VirtualClock
from device.errors import StoreDamaged
from services.identity.birth import FILES, Identity, born
from services.identity.boot import Computer
from tests.house import ROOT

SERIAL = "10000000a1b2c3d4"
BORN = """\
import sys
from pathlib import Path
from device.clock import SystemClock
from services.identity.birth import born
print("ready", flush=True)
born(Path(sys.argv[1]), sys.argv[2], SystemClock())
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    """A root filesystem as a release lays it out, on a board that says its number as a Raspberry Pi does."""
    for name in ("proc/device-tree", "etc/diffuscope", "data"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "proc/device-tree/serial-number").write_text(f"{SERIAL.upper()}\0")
    shutil.copy(ROOT / "systemd/image/access-point.nmconnection", tmp_path / "etc/diffuscope")
    return Computer(tmp_path)


def test_it_is_made_once_and_read_ever_after(tmp_path: Path) -> None:
    first = born(tmp_path / "data/identity", SERIAL, VirtualClock())
    kept = contents(tmp_path / "data/identity")
    assert set(kept) == set(FILES)
    assert born(tmp_path / "data/identity", "ffffffffffffffff", VirtualClock()) == first
    assert contents(tmp_path / "data/identity") == kept
    assert first.name == "diffuscope-b2c3d4"
    assert stat.S_IMODE((tmp_path / "data/identity").stat().st_mode) == 0o700


def test_two_devices_share_nothing(tmp_path: Path) -> None:
    one, other = (born(tmp_path / name, SERIAL, VirtualClock()) for name in ("one", "other"))
    assert one.wifi != other.wifi
    assert one.machine_id != other.machine_id
    assert one.authority_key != other.authority_key
    assert re.fullmatch(r"([a-hjkmnp-z2-9]{4}-){3}[a-hjkmnp-z2-9]{4}", one.wifi)


def test_a_first_start_that_is_cut_is_finished_by_the_next(tmp_path: Path) -> None:
    """Killed at twelve moments between the first write and some time after the last: none, or a whole one."""
    found, takes_s = [], 0.0
    for cut in range(-1, 12):
        folder = tmp_path / str(cut) / "identity"
        words = [sys.executable, "-c", BORN, folder, SERIAL]
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            begin_s = time.monotonic()
            if cut < 0:  # the first one is let be, to see how long it takes
                process.wait()
                takes_s = time.monotonic() - begin_s
            time.sleep(takes_s * cut / 10 if cut > 0 else 0)
            process.kill()
        whole = contents(folder) if folder.exists() else None
        found.append(whole is not None)
        made = born(folder, SERIAL, SystemClock())
        assert made == born(folder, SERIAL, SystemClock())
        assert [path.name for path in folder.parent.iterdir()] == ["identity"], "what was cut short is cleared away"
        if whole is not None:
            assert contents(folder) == whole, "what was whole is not made anew"
    print(f"{sum(found)} of {len(found)} were whole when they were cut")  # noqa: T201


def test_a_damaged_identity_is_an_error_and_is_not_replaced(tmp_path: Path) -> None:
    """Tablets trust it and its label is printed: a new one, silently, would be worse than none."""
    folder = tmp_path / "identity"
    born(folder, SERIAL, VirtualClock())
    for name in ("wifi", "machine-id"):
        whole = (folder / name).read_bytes()
        for damaged in (b"", whole[:-1], b"\0" * len(whole)):
            (folder / name).write_bytes(damaged)
            with pytest.raises(StoreDamaged, match=name):
                born(folder, SERIAL, VirtualClock())
            assert (folder / name).read_bytes() == damaged
        (folder / name).write_bytes(whole)
    (folder / "authority.key").unlink()
    with pytest.raises(StoreDamaged, match=r"authority\.key") as told:
        born(folder, SERIAL, VirtualClock())
    assert "new label" in told.value.remedy


def test_every_boot_lays_out_the_same_who_and_a_new_servers_key(computer: Computer) -> None:
    for _ in range(2):  # the second boot finds a root that knows nothing
        identity = born(computer.data / "identity", computer.serial(), VirtualClock())
        shutil.rmtree(computer.root / "run", ignore_errors=True)
        computer.becomes(identity, SystemClock())
        assert (computer.root / "etc/hostname").read_text() == "diffuscope-b2c3d4\n"
        point = computer.root / "run/NetworkManager/system-connections/access-point.nmconnection"
        assert "ssid=diffuscope-b2c3d4\nband" in point.read_text()
        assert f"psk={identity.wifi}\n" in point.read_text()
        assert "@" not in point.read_text()
        secret = [path for path in (computer.root / "run").rglob("*") if path.is_file()]
        assert len(secret) == 4
        assert {stat.S_IMODE(path.stat().st_mode) for path in secret} == {0o600}


def test_a_board_without_a_number_keeps_the_one_that_it_drew(computer: Computer) -> None:
    (computer.root / "proc/device-tree/serial-number").unlink()
    first = born(computer.data / "identity", computer.serial(), VirtualClock())
    assert born(computer.data / "identity", computer.serial(), VirtualClock()) == first
    assert re.fullmatch("diffuscope-[0-9a-f]{6}", first.name)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
@pytest.mark.parametrize("name", ["diffuscope.local", "diffuscope-b2c3d4.local"])
def test_openssl_trusts_the_server_by_each_of_its_names(computer: Computer, name: str) -> None:
    identity = laid_out(computer)
    said = verified(computer, identity, "-verify_hostname", name)
    assert said.returncode == 0, said.stdout + said.stderr
    said = verified(computer, identity, "-verify_ip", "10.42.0.1")
    assert said.returncode == 0, said.stdout + said.stderr


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_the_authority_vouches_for_no_other_name(computer: Computer) -> None:
    """A stolen device's key must not become the key to a tablet's bank."""
    identity = laid_out(computer)
    assert verified(computer, identity, "-verify_hostname", "bank.example").returncode != 0
    asked = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "9"]
    sign = ["-CA", computer.root / "ca.crt", "-CAkey", computer.data / "identity/authority.key"]
    name = ["-subj", "/CN=bank.example", "-addext", "subjectAltName=DNS:bank.example"]
    out = ["-keyout", computer.root / "bank.key", "-out", computer.root / "run/diffuscope-identity/server.crt"]
    subprocess.run(["openssl", *asked, *sign, *name, *out], check=True, capture_output=True)
    said = verified(computer, identity, "-verify_hostname", "bank.example")
    assert said.returncode != 0
    assert "permitted subtree violation" in said.stdout + said.stderr


def laid_out(computer: Computer) -> Identity:
    identity = born(computer.data / "identity", computer.serial(), VirtualClock())
    computer.becomes(identity, SystemClock())
    (computer.root / "ca.crt").write_bytes(identity.authority_crt)
    return identity


def verified(computer: Computer, identity: Identity, *more: str) -> "subprocess.CompletedProcess[str]":
    words = ["openssl", "verify", "-x509_strict", "-purpose", "sslserver", "-CAfile", computer.root / "ca.crt", *more]
    at = computer.root / "run/diffuscope-identity/server.crt"
    return subprocess.run([*words, at], capture_output=True, text=True, check=False)
