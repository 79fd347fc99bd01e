"""The card as a technician writes it, and its first boot: genimage and systemd-repart do it for real, on files.

The kernel and Raspberry Pi's firmware are stand-ins, for they come from an archive of its own; layout, names, what the
firmware reads and what the first boot adds are those that ship.
"""

import configparser
import gzip
import json
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from services.update.bootchooser import PARTITIONS, BootChooser
from tests.appliance.device import FOLDERS, run
from tests.house import ROOT

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(240)]

IMAGE = ROOT / "systemd" / "image"
CARD = IMAGE / "card"
NAMES = ["chooser", "boot-a", "boot-b", "root-a", "root-b"]
GROWN_MB = 7000
KERNEL = "6.6.31+rpt-rpi-2712"
SHIPPED = {
    "fstab": "etc/fstab",
    "repart.conf": "etc/repart.d/50-data.conf",
    "../diffuscope.service": "etc/systemd/system/diffuscope.service",
}


def tree_of(folder: Path, encrypt: str = "n") -> Path:
    """A root filesystem as small as it can be, with everything in it that a card needs."""
    tree = folder / "tree"
    for name in ("opt/diffuscope/.venv/lib/python3.11/site-packages", "boot/firmware", "boot/chooser", "data", "proc"):
        (tree / name).mkdir(parents=True)
    for ours, theirs in SHIPPED.items():
        run("install", "-D", "--mode=644", IMAGE / ours, tree / theirs)
    kernel = gzip.compress(b"a kernel" * 1000 + f"\0Linux version {KERNEL} (somebody) \0".encode())
    (tree / "boot/firmware/kernel_2712.img").write_bytes(kernel)
    run(CARD / "board", tree, encrypt)
    return tree


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The image that is written onto a card."""
    here = tmp_path_factory.mktemp("card")
    tree = tree_of(here)
    (here / "input").mkdir()
    words = ["--config", CARD / "image/genimage.cfg", "--rootpath", tree, "--tmppath", here / "tmp"]
    run("genimage", *words, "--inputpath", here / "input", "--outputpath", here / "out")
    return here / "out/diffuscope.img"


def repart_words(definitions: Path, file: Path) -> list[object]:
    return ["systemd-repart", "--dry-run=no", f"--definitions={definitions}", "--no-pager", file]


def repart(definitions: Path, file: Path) -> None:
    """What systemd-repart.service does at every boot."""
    run(*repart_words(definitions, file))


@contextmanager
def mounted(file: Path, where: dict[str, int], at: Path) -> Iterator[Path]:
    at.mkdir(exist_ok=True)
    run("mount", "-o", f"loop,offset={where['at']},sizelimit={where['bytes']}", file, at)
    try:
        yield at
    finally:
        run("umount", at)


def same(one: Path, other: Path, where: dict[str, int]) -> bool:
    """Whether a partition's first megabytes, where its files are, have the same bytes on both cards."""
    with one.open("rb") as first, other.open("rb") as second:
        first.seek(where["at"])
        second.seek(where["at"])
        size = min(where["bytes"], 8 << 20)
        return first.read(size) == second.read(size)


def partitions(card: Path) -> dict[str, dict[str, int]]:
    said = run("partx", "--bytes", "--output", "NR,NAME,START,SIZE", "--pairs", card)
    rows = [dict(re.findall(r'(\w+)="([^"]*)"', line)) for line in said.splitlines()]
    return {
        row["NAME"]: {"nr": int(row["NR"]), "at": int(row["START"]) * 512, "bytes": int(row["SIZE"])} for row in rows
    }


def read(card: Path, partition: str, name: str) -> str:
    """A file on one of the FAT partitions."""
    at = partitions(card)[partition]["at"]
    return run("mtype", "-i", f"{card}@@{at}", f"::{name}")


def of_slot(config: str, number: int) -> dict[str, str]:
    """What config.txt says to the firmware on this partition: its sections hold until the next."""
    said: dict[str, str] = {}
    heard = True
    for line in config.splitlines():
        if section := re.fullmatch(r"\[(.+)\]", line):
            heard = section[1] in ("all", f"boot_partition={number}")
        elif heard and (setting := re.fullmatch(r"([a-z0-9_]+)=(.+)", line)):
            said[setting[1]] = setting[2]
    return said


def test_the_partitions_are_those_that_firmware_rauc_and_updates_expect(card: Path, tmp_path: Path) -> None:
    found = partitions(card)
    assert list(found) == NAMES
    assert [found[f"boot-{slot.lower()}"]["nr"] for slot in PARTITIONS] == list(PARTITIONS.values())
    assert found["root-a"]["bytes"] == found["root-b"]["bytes"] > 1_500_000_000
    conf = configparser.ConfigParser()
    conf.read(IMAGE / "system.conf")
    for kind, names in {"rootfs": ["root-a", "root-b"], "boot": ["boot-a", "boot-b"]}.items():
        assert [Path(conf[f"slot.{kind}.{number}"]["device"]).name for number in (0, 1)] == names
    assert [conf[f"slot.boot.{number}"]["parent"] for number in (0, 1)] == ["rootfs.0", "rootfs.1"]
    (tmp_path / "autoboot.txt").write_text(read(card, "chooser", "autoboot.txt"))
    assert BootChooser(autoboot=tmp_path / "autoboot.txt").committed() == "A"


@pytest.mark.parametrize("slot", PARTITIONS)
def test_each_slot_tells_the_kernel_which_root_is_its_own(card: Path, tmp_path: Path, slot: str) -> None:
    settings = of_slot(read(card, f"boot-{slot.lower()}", "config.txt"), PARTITIONS[slot])
    (tmp_path / "cmdline").write_text(words := read(card, f"boot-{slot.lower()}", settings["cmdline"]))
    assert words.count("\n") <= 1, "the kernel's words are one line"
    assert f"root=PARTLABEL=root-{slot.lower()}" in words.split()
    assert {"rootfstype=squashfs", "ro", "rootwait", "systemd.volatile=overlay", "panic=10"} <= set(words.split())
    assert BootChooser(command_line=tmp_path / "cmdline").booted() == slot


def bundle(card: Path, root: Path, *more: object) -> subprocess.CompletedProcess[str]:
    """What a technician calls to make an update of a card."""
    out = root.with_suffix(".raucb")
    words = [IMAGE / "bundle", "--keys", card.parents[1] / "keys", "--format", "plain", "-o", out, "--image", root]
    return subprocess.run([str(word) for word in (*words, *more)], capture_output=True, text=True, check=False)


def test_an_update_of_a_card_has_the_kernel_of_its_root_or_is_not_made(card: Path, tmp_path: Path) -> None:
    """The two are one slot: RAUC finds both in the bundle, and a kernel without its modules is refused at once."""
    run(IMAGE / "keys", card.parents[1] / "keys")
    boot = card.parent / "boot.vfat"
    for kernel in (KERNEL, "6.1.0"):
        tree = tmp_path / kernel
        (tree / "usr/lib/modules" / kernel).mkdir(parents=True)
        (tree / "usr/share/diffuscope").mkdir(parents=True)
        (tree / "usr/share/diffuscope/sbom.cdx.json").write_text("{}")
        (tree / "usr/share/diffuscope/release.json").write_text('{"version": "2.0", "git": "0", "minimum": "1.0"}')
        run("mksquashfs", tree, tmp_path / f"{kernel}.squashfs", "-quiet", "-no-progress")
    ours, other = (tmp_path / f"{kernel}.squashfs" for kernel in (KERNEL, "6.1.0"))
    assert "needs that kernel" in bundle(card, ours).stderr
    assert f"is {KERNEL}, and the root has modules of 6.1.0" in bundle(card, other, "--boot", boot).stderr
    made = bundle(card, ours, "--boot", boot)
    assert made.returncode == 0, made.stderr
    keyring = f"--keyring={card.parents[1] / 'keys/ca.crt'}"
    said = json.loads(run("rauc", keyring, "info", "--output-format=json", ours.with_suffix(".raucb")))
    assert {name: image["filename"] for one in said["images"] for name, image in one.items()} == {
        "rootfs": "rootfs.img", "boot": "boot.img",
    }  # fmt: skip


def test_a_root_has_no_kernel_and_no_choice_in_it(card: Path, tmp_path: Path) -> None:
    """What an update replaces must not carry what decides about updates."""
    at = partitions(card)["root-a"]
    said = run("unsquashfs", "-l", "-o", at["at"], card)
    assert "squashfs-root/etc/fstab" in said
    assert "kernel_2712.img" not in said
    assert "autoboot.txt" not in said


def test_the_first_boot_makes_a_data_partition_and_the_second_changes_nothing(card: Path, tmp_path: Path) -> None:
    file = tmp_path / "card.img"
    run("cp", "--sparse=always", card, file)
    run("truncate", "-s", f"{GROWN_MB}M", file)
    definitions = tree_of(tmp_path) / "etc/repart.d"
    begin_s = time.monotonic()
    repart(definitions, file)
    print(f"data partition made in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # a figure for who reads the log (-rP)
    found = partitions(file)
    assert list(found) == [*NAMES, "data"]
    assert found["data"]["bytes"] > 1_500_000_000, "all that is left on the card"
    with mounted(file, found["data"], tmp_path / "data") as data:
        assert {path.name for path in data.iterdir()} == {*FOLDERS, "lost+found"}
        (data / "captures/kept").write_text("a picture")
    assert run("blkid", "-p", "-s", "LABEL", "-o", "value", "-O", found["data"]["at"], file).strip() == "data"
    repart(definitions, file)
    assert partitions(file) == found
    with mounted(file, found["data"], tmp_path / "data") as data:
        assert (data / "captures/kept").read_text() == "a picture"


def test_a_first_boot_that_is_cut_is_finished_by_the_next(card: Path, tmp_path: Path) -> None:
    """Killed at six moments: no data partition, or a whole one; what was on the card before is untouched."""
    definitions = tree_of(tmp_path) / "etc/repart.d"
    found, takes_s = [], 0.0
    for cut in range(-1, 6):
        file = tmp_path / f"{cut}.img"
        run("cp", "--sparse=always", card, file)
        run("truncate", "-s", f"{GROWN_MB}M", file)
        words, begin_s = [str(word) for word in repart_words(definitions, file)], time.monotonic()
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            if cut < 0:  # the first one is let be, to see how long it takes
                process.wait()
                takes_s = time.monotonic() - begin_s
            time.sleep(takes_s * cut / 5 if cut > 0 else 0)
            process.kill()
        found.append("data" in partitions(file))
        repart(definitions, file)
        assert list(partitions(file)) == [*NAMES, "data"]
        with mounted(file, partitions(file)["data"], tmp_path / "data") as data:
            assert {path.name for path in data.iterdir()} == {*FOLDERS, "lost+found"}
        for name in NAMES:
            assert same(card, file, partitions(card)[name]), f"{name} is not what was written"
        file.unlink()
    print(f"{sum(found)} of {len(found)} had a data partition when they were cut")  # noqa: T201  # a figure for who reads the log (-rP)


def test_the_encrypted_card_has_a_key_before_it_has_a_partition(tmp_path: Path) -> None:
    """Read by systemd-repart and by eye; to make it, a kernel needs device-mapper."""
    tree = tree_of(tmp_path, "y")
    assert "/dev/mapper/data  /data" in re.sub(" +", "  ", (tree / "etc/fstab").read_text())
    name, source, key, _ = (tree / "etc/crypttab").read_text().splitlines()[-1].split()
    assert (name, source) == ("data", "PARTLABEL=data")
    assert f"--key-file={key}" in (tree / "etc/systemd/system/systemd-repart.service.d/key.conf").read_text()
    assert (tree / "etc/systemd/system/sysinit.target.wants/diffuscope-key.service").is_symlink()
    (tmp_path / "key").touch(mode=0o600)
    (tmp_path / "key").write_bytes(bytes(range(32)))
    run("truncate", "-s", "2G", tmp_path / "empty.img")
    words = ["systemd-repart", "--dry-run=yes", "--empty=force", f"--key-file={tmp_path / 'key'}", "--json=short"]
    planned = run(*words, f"--definitions={tree / 'etc/repart.d'}", tmp_path / "empty.img")
    assert [row["label"] for row in json.loads(planned)] == ["data"]
    assert "Encrypt=key-file" in (tree / "etc/repart.d/50-data.conf").read_text()
