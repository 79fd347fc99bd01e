"""Cases of power cuts on FAT: the choice of the boot slot, and the export of a visit to a USB drive.

FAT has no journal; power.py simulates the partial effects of its renames. The firmware is tests/firmware.py.
"""

from collections.abc import Callable
from pathlib import Path

from services.delivery.usb_drives import copy_to_drive
from services.update.bootchooser import PARTITIONS, BootChooser, other, write_atomically
from services.update.state import StateFile
from tests import firmware

FILES = {"raw.tiff": bytes(range(256)) * 40, "picture.png": b"png" * 300, "report.json": b"{}"}
CHOICE = "[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n"
VISIT = "PN-0007-4f1c"


def chooser(folder: Path) -> BootChooser:
    return BootChooser(folder / "chooser/autoboot.txt", folder, folder / "word", folder / "cmdline")


def with_choice(folder: Path) -> None:
    (folder / "chooser").mkdir()
    (folder / "chooser/autoboot.txt").write_text(CHOICE)
    (folder / "cmdline").write_text("rauc.slot=B\n")
    StateFile(folder).write(state="installed", version="2.0")


def commit(folder: Path, acknowledge: Callable[[str], None]) -> None:
    StateFile(folder).write(state="trying")
    chooser(folder).set_good("B")
    acknowledge("B")
    StateFile(folder).write(state="committed")
    acknowledge("committed")


def judge_choice(folder: Path, acknowledged: list[str]) -> str:
    slot, entry = chooser(folder).committed(), StateFile(folder).read()
    autoboot = (folder / "chooser/autoboot.txt").read_bytes()
    assert firmware.partition(autoboot) == PARTITIONS[slot]
    assert firmware.partition(autoboot, tried=True) == PARTITIONS[other(slot)]
    assert slot == "B" or not acknowledged
    assert entry.version == "2.0"
    assert entry.state in {"installed", "trying", "committed"}
    assert entry.state == "committed" or "committed" not in acknowledged
    return slot


def commit_by_rename(folder: Path, acknowledge: Callable[[str], None]) -> None:
    """Commit as RAUC's own backend for this firmware does; correct on a journaling file system only."""
    write_atomically(folder / "chooser/autoboot.txt", CHOICE.replace("2", "x").replace("3", "2").replace("x", "3"))
    acknowledge("B")


def judge_rename(folder: Path, acknowledged: list[str]) -> str:
    path = folder / "chooser/autoboot.txt"
    number = firmware.partition(path.read_bytes() if path.exists() else None)
    if number is None:
        return "no choice"
    return "lost" if acknowledged and number != PARTITIONS["B"] else firmware.SLOTS[number]


def with_stick(folder: Path) -> None:
    (folder / "stick").mkdir()


def export(folder: Path, acknowledge: Callable[[str], None]) -> None:
    copy_to_drive(folder / "stick", VISIT, FILES)
    acknowledge("out")


def judge_export(folder: Path, acknowledged: list[str]) -> str:
    """The visit's folder is complete or empty, and another export succeeds."""
    visit = folder / "stick" / VISIT
    outcome = "new" if visit.exists() else "old"
    found = {path.name: path.read_bytes() for path in visit.iterdir()} if visit.exists() else {}
    assert found in ({}, FILES)
    assert found == FILES or not acknowledged
    again = copy_to_drive(folder / "stick", VISIT, FILES)
    assert {path.name: path.read_bytes() for path in again.iterdir()} == FILES
    return outcome if found or outcome == "old" else "empty"
