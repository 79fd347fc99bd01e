"""Boots of the card in QEMU: first boot, page, device nodes, settings, a capture, power cuts, update and rollback.

The tests are steps of one life of one card, in the order of this file; `make test-boot` ends at the first failure.
"""

import json
import os
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import pytest

from services.identity.ssh_keys import fingerprint
from tests.boot.machine import CARD_MB, Board, Card, run, wait_until
from tests.debian_kernel import CONFIG
from tests.project_files import ROOT
from tests.systemd.machine import UNIT

pytestmark = [pytest.mark.boot, pytest.mark.timeout(1500)]

ARCH = os.environ.get("ARCH") or "arm64"
HERE = ROOT / "tests/boot"
PYTHON = "/opt/diffuscope/.venv/bin/python"
DIFFUSCOPE = "diffuscope"  # as remedies write it
BROKEN = '"""A release that ends as soon as it is asked to serve."""\n\nraise SystemExit("broken release")\n'
CONFIRMED = "[Service]\nExecStartPre=/usr/bin/cp /etc/diffuscope/ssh-keys.json /data/captures/\n"
IMPATIENT = 'sticks = "/media"\npatience_s = 25.0\n'
PASSWORD = "eight or more"
SETTINGS = f"""\
time_zone = "Africa/Nairobi"
head = "sim"
[wifi]
name = "Clinic"
password = "{PASSWORD}"
[ssh]
keys = ["%s"]
"""
# Owner and mode that `image/devices.rules` and Debian's own rules give.
OWNERS = {"spidev": "spi", "i2c-": "i2c", "gpiochip": "gpio", "video": "video", "media": "video", "system": "video"}
# Written as the chip transmits: high byte first.
SET_25_C = """\
from pathlib import Path
from smbus2 import SMBus
bus = next(file.parent.name for file in Path("/sys/class/i2c-dev").glob("*/name") if "stub" in file.read_text())
SMBus(f"/dev/{bus}").write_word_data(0x48, 0, 0x800C)
"""
# The unit of the instrument with another program: user, groups, devices, folders and system calls stay.
OTHER_PROGRAM = re.compile(
    "^(Type|Exec.*|Restart.*|Watchdog.*|OnFailure|Requires|Wants|After|StateDirectory.*|CacheDirectory|EnvironmentFile)=.*\n",
    re.MULTILINE,
)
PROBE = f"[Service]\nType=oneshot\nExecStart={PYTHON} /run/probe/probe.py\nStandardOutput=file:/run/probe/found\n"


def say(line: str) -> None:
    """Print a figure for the log of `make test-boot` (-rP)."""
    sys.stdout.write(f"{line}\n")


@dataclass(frozen=True)
class Builds:
    """Card of version 1.0.0 and USB drives with the updates 1.1.0 and, broken, 1.2.0; `key`: confirmed for SSH."""

    key: Path
    card: Path
    good: Path
    broken: Path


def build(folder: Path, version: str, overlay: Path | None = None) -> Path:
    """Build the card's files of a version; return their folder."""
    out = folder / version
    words = [HERE / "image", ARCH, folder / "keys", out, version, *([overlay] if overlay else [])]
    say(f"{version}: Linux {run(*words, limit_s=1500).strip()}")
    return out


def drive_with_update(folder: Path, files: Path) -> Path:
    """Return the image of a USB drive (FAT) with the signed update of a card's files."""
    bundle, drive = folder / f"{files.name}.raucb", folder / f"{files.name}.drive"
    parts = ["--image", files / "root.squashfs", "--boot", files / "boot.vfat"]
    run(ROOT / "systemd/image/bundle", "--keys", folder / "keys", "-o", bundle, *parts, limit_s=600)
    run("truncate", "-s", "900M", drive)
    run("mkfs.vfat", "-F", "32", "-n", "UPDATE", drive)
    run("mcopy", "-i", drive, bundle, "::")
    bundle.unlink()
    return drive


@pytest.fixture(scope="module")
def builds(tmp_path_factory: pytest.TempPathFactory) -> Builds:
    folder = tmp_path_factory.mktemp("builds")
    begin_s = time.monotonic()
    run(ROOT / "systemd/image/keys", folder / "keys")
    broken = folder / "overlay"
    for name, text in {
        "opt/diffuscope/services/http/server.py": BROKEN,
        "etc/diffuscope/update.toml": IMPATIENT,
    }.items():
        (broken / name).parent.mkdir(parents=True, exist_ok=True)
        (broken / name).write_text(text)
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / "key")
    confirmed = folder / "confirmed"  # in place of an administrator at the device
    for name, text in {
        "etc/diffuscope/ssh-keys.json": json.dumps({fingerprint((folder / "key.pub").read_text()): True}),
        "etc/systemd/system/diffuscope-identity.service.d/confirmed.conf": CONFIRMED,
    }.items():
        (confirmed / name).parent.mkdir(parents=True, exist_ok=True)
        (confirmed / name).write_text(text)
    card, good, bad = build(folder, "1.0.0", confirmed), build(folder, "1.1.0"), build(folder, "1.2.0", broken)
    drives = [drive_with_update(folder, files) for files in (good, bad)]
    made = Builds(folder / "key", card / "diffuscope.img", *drives)
    say(f"card and two updates built in {time.monotonic() - begin_s:.0f} s")
    return made


@pytest.fixture(scope="module")
def board(builds: Builds, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Board]:
    """Board with a new card in which a person has put the settings."""
    folder = tmp_path_factory.mktemp("board")
    card = Card(builds.card)
    card.grow(CARD_MB)
    settings = folder / "diffuscope.toml"
    settings.write_text(SETTINGS % builds.key.with_suffix(".pub").read_text().strip())
    card.write("chooser", settings)
    board = Board(folder, ARCH, card, builds.key)
    yield board
    board.cut_power()


def no_unit_failed(board: Board) -> None:
    """Check that systemd reports no failed unit; the message has the journal of those that failed."""
    failed = board.ssh("systemctl", "--failed", "--plain", "--no-legend").split("\n")
    units = [line.split()[0] for line in failed if line]
    logs = [board.ssh("journalctl", "-b", "-u", unit, "-n", "30", "--no-pager") for unit in units]
    assert units == [], "\n".join(logs)


def captures(board: Board) -> dict[str, str]:
    """Return the SHA-256 of every stored file, by path, computed on the board."""
    lines = board.ssh("find /data/captures/captures -type f | sort | xargs -r sha256sum").splitlines()
    return {line.split(maxsplit=1)[1]: line.split()[0] for line in lines}


def press(board: Board) -> None:
    """Take one picture through the page's API."""
    begin_s = time.monotonic()
    board.ask("captures", {"eye": "OD"})
    say(f"capture answered in {time.monotonic() - begin_s:.1f} s")


def test_first_boot_whose_power_is_cut_is_completed_by_the_next(board: Board) -> None:
    board.power_on()
    took_s = wait_until(lambda: "data" in board.card.partitions(), 300, f"the data partition: {board.console}", 0.05)
    board.cut_power()
    say(f"power cut {took_s:.0f} s after power-on, when the data partition was in the table")
    board.power_on()
    say(f"login {board.wait_for_login():.0f} s after power-on")
    assert board.ssh("findmnt", "-rno", "FSTYPE", "/").strip() == "overlay"
    assert board.ssh("blkid", "-o", "value", "-s", "TYPE", "/dev/disk/by-partlabel/root-a").strip() == "squashfs"
    assert "/data" in board.ssh("findmnt", "-rno", "TARGET", "/data")
    assert board.ssh("ls", "/data/identity").split()


def test_page_is_served_after_power_on(board: Board) -> None:
    took_s = board.wait_for_page()
    no_unit_failed(board)
    assert board.ssh("systemctl", "is-enabled", "rpi-eeprom-update.service", check=False).strip() == "masked"
    here = run(sys.executable, "-m", "tests.boot.probe", "fft")
    board.ssh("mkdir", "-p", "/run/probe")
    board.copy(HERE / "probe.py", "/run/probe/")
    there = board.ssh(PYTHON, "/run/probe/probe.py", "fft")
    say(f"page reports aim {took_s:.0f} s after power-on (limit 600)")
    say(f"planned FFT pair 1080 x 1920: {here.strip()} s on this machine, {there.strip()} s emulated ({ARCH})")


def test_kernel_has_the_facts_that_the_image_is_checked_against(board: Board) -> None:
    lines = board.ssh("cat /boot/config-$(uname -r)").splitlines()
    there = dict(line.removeprefix("CONFIG_").split("=", 1) for line in lines if line.startswith("CONFIG_"))
    assert {name: there.get(name, "n") for name in CONFIG[ARCH]} == CONFIG[ARCH]


def test_instrument_opens_its_devices_and_no_other_from_its_sandbox(board: Board) -> None:
    board.ssh(PYTHON, "-c", f"'{SET_25_C}'")
    unit = board.folder / "probe.service"
    unit.write_text(
        OTHER_PROGRAM.sub("", board.ssh("cat", f"/etc/systemd/system/{UNIT}")).replace("[Service]\n", PROBE)
    )
    board.copy(unit, "/run/systemd/system/")
    board.ssh("systemctl", "daemon-reload")
    board.ssh("systemctl start probe.service || journalctl -u probe.service -n 40 --no-pager")
    found = json.loads(board.ssh("cat", "/run/probe/found"))
    modes = board.ssh("stat", "-c", "'%n %a %U:%G'", *found["nodes"]).splitlines()
    say("| node | mode | owner | from the sandbox |\n|---|---|---|---|")
    for line in modes:
        node, mode, owner = line.split()
        say(f"| {node} | {mode} | {owner} | {found['nodes'][node]} |")
        group = next(group for start, group in OWNERS.items() if Path(node).name.startswith(start))
        assert (mode, owner, found["nodes"][node]) == ("660", f"root:{group}", "opens"), line
    there = {name for name in OWNERS for node in found["nodes"] if Path(node).name.startswith(name)}
    kernel = {"arm64": {"spidev", "i2c-", "gpiochip", "video", "media"}, "amd64": {"i2c-", "video", "media", "system"}}
    assert there == kernel[ARCH]
    assert found["user"] != 0
    assert "opens" not in found["forbidden"].values()
    assert found["frame"]["shape"] == [720, 1280]
    assert found["frame"]["levels"] >= 8, "vivid's picture has eight bars"
    assert found["temperature_c"] == 25.0
    say(f"one frame of vivid: {found['frame']}; thermometer (i2c-stub): {found['temperature_c']} degrees Celsius")


def test_settings_of_the_card_are_taken_and_its_password_is_removed(board: Board) -> None:
    assert board.ssh("readlink", "/etc/localtime").strip().endswith("Africa/Nairobi")
    assert "heads/sim.toml" in board.ssh("cat", "/run/diffuscope-settings/instrument.env")
    assert PASSWORD in board.ssh("cat", "/data/settings/diffuscope.toml")
    on_card = board.ssh("cat", "/boot/chooser/diffuscope.toml")
    assert PASSWORD not in on_card
    assert "*" * len(PASSWORD) in on_card
    assert board.ssh("nmcli", "-g", "connection.id", "connection", "show", "wifi").strip() == "wifi"


def test_power_cut_during_a_capture_loses_no_earlier_capture(board: Board) -> None:
    press(board)
    kept = captures(board)
    assert kept
    taking = Thread(target=press_until_the_power_is_cut, args=(board,))
    taking.start()
    wait_until(lambda: board.page_state() in ("busy", "making"), 60, "a capture in progress", 0.05)
    board.cut_power()
    taking.join()
    nonsense = board.folder / "nonsense"
    nonsense.mkdir()
    before = board.card.text("chooser", "diffuscope.toml")
    (nonsense / "diffuscope.toml").write_text('head = "no_such_head"\n')
    board.card.write("chooser", nonsense / "diffuscope.toml")
    board.power_on()
    say(f"page reports aim {board.wait_for_page():.0f} s after power-on, after the cut")
    no_unit_failed(board)
    assert {name: digest for name, digest in captures(board).items() if name in kept} == kept
    reported = json.dumps(board.ask("health"))
    assert "no_such_head" in reported
    assert "imx296_power" in reported, "the remedy names the heads"
    assert "heads/sim.toml" in board.ssh("cat", "/run/diffuscope-settings/instrument.env")
    assert "no_such_head" in board.ssh("cat", "/run/issue.d/settings.issue")
    (nonsense / "diffuscope.toml").write_text(before)
    board.copy(nonsense / "diffuscope.toml", "/boot/chooser/")


def press_until_the_power_is_cut(board: Board) -> None:
    try:
        press(board)
    except OSError as error:
        say(f"the press ended with the power: {error!r}")


def slot_of(board: Board) -> str:
    return board.ssh("sed 's/.*rauc.slot=\\([AB]\\).*/\\1/' /proc/cmdline").strip()


def start_update(board: Board) -> None:
    board.ssh("systemd-run", "--quiet", "--no-block", "--unit=technician", DIFFUSCOPE, "update", "install")


def wait_for_drive(board: Board) -> None:
    wait_until(lambda: ".raucb" in board.ssh("ls /media/*", check=False), 60, "a mounted USB drive", 2)


def test_power_cut_during_an_update_leaves_the_running_version(board: Board, builds: Builds) -> None:
    board.insert(builds.good, "usb1")
    wait_for_drive(board)
    other = board.card.head_of("root-b")
    start_update(board)
    took_s = wait_until(lambda: board.card.head_of("root-b") != other, 400, "a write to the other root", 0.05)
    board.cut_power()
    say(f"power cut {took_s:.0f} s after the start of the update, when the other root was being written")
    board.power_on(builds.good)
    say(f"page reports aim {board.wait_for_page():.0f} s after power-on, after the cut")
    no_unit_failed(board)
    assert slot_of(board) == "A"
    assert "1.0.0" in board.ssh(DIFFUSCOPE, "update", "status")


def test_update_is_tried_and_committed(board: Board) -> None:
    kept = captures(board)
    wait_for_drive(board)
    start_update(board)
    say(f"1.1.0 installed and restarted in {board.wait_for_restart(600):.0f} s")
    assert (board.tried, board.card.selected(False)) == (True, "boot-a")
    board.power_on()
    assert board.booted == "boot-b"
    say(f"page of 1.1.0 reports aim {board.wait_for_page():.0f} s after power-on")
    wait_until(lambda: "Updated to 1.1.0" in board.ssh(DIFFUSCOPE, "update", "status"), 500, "the commit", 5)
    assert board.ssh("sed -n 3p /boot/chooser/autoboot.txt").strip() == "boot_partition=3"
    assert slot_of(board) == "B"
    no_unit_failed(board)
    assert captures(board) == kept
    press(board)


def test_broken_update_is_rolled_back_and_every_capture_stays(board: Board, builds: Builds) -> None:
    kept = captures(board)
    identity = board.ssh("cat /data/identity/* | sha256sum")
    board.insert(builds.broken, "usb2")
    wait_for_drive(board)
    start_update(board)
    say(f"1.2.0 installed and restarted in {board.wait_for_restart(600):.0f} s")
    board.power_on()
    assert board.booted == "boot-a"
    say(f"1.2.0 restarted {board.wait_for_restart(600):.0f} s after its boot")
    assert not board.tried
    board.power_on()
    assert board.booted == "boot-b"
    say(f"page of 1.1.0 reports aim {board.wait_for_page():.0f} s after power-on")
    assert "Version 1.2.0 was tried and was not well, so 1.1.0 is back" in board.ssh(DIFFUSCOPE, "update", "status")
    no_unit_failed(board)
    assert captures(board) == kept
    assert board.ssh("cat /data/identity/* | sha256sum") == identity
    board.power_off()
