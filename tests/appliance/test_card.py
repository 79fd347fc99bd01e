"""SD card image and its first boot: real genimage and systemd-repart, on files.

Kernel and Raspberry Pi firmware are replaced by fakes, because they come from another archive; partition layout, names,
firmware configuration and the first boot's changes are those of a release.
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
from tests.project_files import ROOT

pytestmark = pytest.mark.systemd

IMAGE = ROOT / "systemd" / "image"
CARD = IMAGE / "card"
NAMES = ["chooser", "boot-a", "boot-b", "root-a", "root-b"]
GROWN_MB = 7000
KERNEL = "6.6.31+rpt-rpi-2712"
PYTHON = dict(re.findall(r"^(\w+)=(.+)$", (IMAGE / "suite").read_text(), re.M))["python"]
SHIPPED = {
    "fstab": "etc/fstab",
    "repart.conf": "etc/repart.d/50-data.conf",
    "../diffuscope.service": "etc/systemd/system/diffuscope.service",
}


def tree_of(folder: Path, encrypt: str = "n") -> Path:
    """Create a minimal root file system with everything that a card needs; return its path."""
    tree = folder / "tree"
    for name in (
        f"opt/diffuscope/.venv/lib/python{PYTHON}/site-packages",
        "boot/firmware",
        "boot/chooser",
        "data",
        "proc",
    ):
        (tree / name).mkdir(parents=True)
    for ours, theirs in SHIPPED.items():
        run("install", "-D", "--mode=644", IMAGE / ours, tree / theirs)
    kernel = gzip.compress(b"a kernel" * 1000 + f"\0Linux version {KERNEL} (builder) \0".encode())
    (tree / "boot/firmware/kernel_2712.img").write_bytes(kernel)
    run(CARD / "board", tree, encrypt)
    return tree


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The image that is written to a card."""
    here = tmp_path_factory.mktemp("card")
    tree = tree_of(here)
    (here / "input").mkdir()
    words = ["--config", CARD / "image/genimage.cfg", "--rootpath", tree, "--tmppath", here / "tmp"]
    run("genimage", *words, "--inputpath", here / "input", "--outputpath", here / "out")
    return here / "out/diffuscope.img"


def repart_words(definitions: Path, file: Path) -> list[object]:
    return ["systemd-repart", "--dry-run=no", f"--definitions={definitions}", "--no-pager", file]


def repart(definitions: Path, file: Path) -> None:
    """Run systemd-repart as systemd-repart.service does at every boot."""
    run(*repart_words(definitions, file))


@contextmanager
def mounted(file: Path, where: dict[str, int], at: Path) -> Iterator[Path]:
    at.mkdir(exist_ok=True)
    run("mount", "-o", f"loop,offset={where['at']},sizelimit={where['bytes']}", file, at)
    try:
        yield at
    finally:
        run("umount", at)


def same(left: Path, right: Path, where: dict[str, int]) -> bool:
    """Return whether the first 8 MiB of a partition are equal on both cards."""
    with left.open("rb") as first, right.open("rb") as second:
        first.seek(where["at"])
        second.seek(where["at"])
        size = min(where["bytes"], 8 << 20)
        return first.read(size) == second.read(size)


def partitions(card: Path) -> dict[str, dict[str, int]]:
    output = run("partx", "--bytes", "--output", "NR,NAME,START,SIZE", "--pairs", card)
    rows = [dict(re.findall(r'(\w+)="([^"]*)"', line)) for line in output.splitlines()]
    return {
        row["NAME"]: {"nr": int(row["NR"]), "at": int(row["START"]) * 512, "bytes": int(row["SIZE"])} for row in rows
    }


def read(card: Path, partition: str, name: str) -> str:
    """Return a file of one of the FAT partitions."""
    at = partitions(card)[partition]["at"]
    return run("mtype", "-i", f"{card}@@{at}", f"::{name}")


def of_slot(config: str, number: int) -> dict[str, str]:
    """Return the settings of config.txt that apply to a boot partition."""
    settings: dict[str, str] = {}
    applies = True
    for line in config.splitlines():
        if section := re.fullmatch(r"\[(.+)\]", line):
            applies = section[1] in ("all", f"boot_partition={number}")
        elif applies and (setting := re.fullmatch(r"([a-z0-9_]+)=(.+)", line)):
            settings[setting[1]] = setting[2]
    return settings


def test_partitions_match_firmware_rauc_and_boot_chooser(card: Path, tmp_path: Path) -> None:
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
def test_each_boot_partition_names_its_own_root(card: Path, tmp_path: Path, slot: str) -> None:
    settings = of_slot(read(card, f"boot-{slot.lower()}", "config.txt"), PARTITIONS[slot])
    (tmp_path / "cmdline").write_text(words := read(card, f"boot-{slot.lower()}", settings["cmdline"]))
    assert words.count("\n") <= 1, "the kernel command line is one line"
    assert f"root=PARTLABEL=root-{slot.lower()}" in words.split()
    assert {"rootfstype=squashfs", "ro", "rootwait", "systemd.volatile=overlay", "panic=10"} <= set(words.split())
    assert BootChooser(command_line=tmp_path / "cmdline").booted() == slot


def bundle(card: Path, root: Path, *more: object) -> subprocess.CompletedProcess[str]:
    """Build an update from a card's root, as a technician does."""
    out = root.with_suffix(".raucb")
    words = [IMAGE / "bundle", "--keys", card.parents[1] / "keys", "--format", "plain", "-o", out, "--image", root]
    return subprocess.run([str(word) for word in (*words, *more)], capture_output=True, text=True, check=False)


def test_bundle_of_a_card_needs_the_kernel_of_its_root(card: Path, tmp_path: Path) -> None:
    """RAUC finds root and kernel in the bundle; a kernel without its modules is refused."""
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
    info = json.loads(run("rauc", keyring, "info", "--output-format=json", ours.with_suffix(".raucb")))
    assert {name: image["filename"] for entry in info["images"] for name, image in entry.items()} == {
        "rootfs": "rootfs.img",
        "boot": "boot.img",
    }


def test_root_holds_no_kernel_and_no_autoboot_txt(card: Path, tmp_path: Path) -> None:
    """The replaceable root must not contain the boot selection."""
    at = partitions(card)["root-a"]
    listing = run("unsquashfs", "-l", "-o", at["at"], card)
    assert "squashfs-root/etc/fstab" in listing
    assert "kernel_2712.img" not in listing
    assert "autoboot.txt" not in listing


def test_first_boot_creates_the_data_partition_and_the_second_keeps_it(card: Path, tmp_path: Path) -> None:
    file = tmp_path / "card.img"
    run("cp", "--sparse=always", card, file)
    run("truncate", "-s", f"{GROWN_MB}M", file)
    definitions = tree_of(tmp_path) / "etc/repart.d"
    begin_s = time.monotonic()
    repart(definitions, file)
    print(f"data partition made in {time.monotonic() - begin_s:.1f} s")  # noqa: T201  # figure for the log (-rP)
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


def test_interrupted_first_boot_is_completed_by_the_next(card: Path, tmp_path: Path) -> None:
    """Kill at six moments: no data partition or a complete one; the other partitions are unchanged."""
    definitions = tree_of(tmp_path) / "etc/repart.d"
    found, takes_s = [], 0.0
    for cut in range(-1, 6):
        file = tmp_path / f"{cut}.img"
        run("cp", "--sparse=always", card, file)
        run("truncate", "-s", f"{GROWN_MB}M", file)
        words, begin_s = [str(word) for word in repart_words(definitions, file)], time.monotonic()
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            if cut < 0:  # the first one is not killed, to measure its duration
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
    print(f"{sum(found)} of {len(found)} had a data partition when they were cut")  # noqa: T201  # figure for the log (-rP)


def test_encrypted_card_creates_its_key_before_the_partition(tmp_path: Path) -> None:
    """A dry run of systemd-repart and a check of the files; a real run needs device-mapper."""
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
