"""What is written onto FAT while the power may go: the choice of the slot that boots, and a visit on a stick.

FAT has no journal: `power.py` knows how its renames come apart. The firmware is `tests/firmware.py`.
"""

from collections.abc import Callable
from pathlib import Path

from services.instrument.exporting import copied
from services.update.bootchooser import PARTITIONS, BootChooser, other, write_whole
from services.update.journal import Journal
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
    Journal(folder).write(state="installed", version="2.0")


def commit(folder: Path, say: Callable[[str], None]) -> None:
    Journal(folder).write(state="trying")
    chooser(folder).set_good("B")
    say("B")
    Journal(folder).write(state="committed")
    say("committed")


def judge_choice(folder: Path, said: list[str]) -> str:
    slot, entry = chooser(folder).committed(), Journal(folder).read()
    autoboot = (folder / "chooser/autoboot.txt").read_bytes()
    assert firmware.partition(autoboot) == PARTITIONS[slot]
    assert firmware.partition(autoboot, tried=True) == PARTITIONS[other(slot)]
    assert slot == "B" or not said
    assert entry.version == "2.0"
    assert entry.state in {"installed", "trying", "committed"}
    assert entry.state == "committed" or "committed" not in said
    return slot


def commit_by_rename(folder: Path, say: Callable[[str], None]) -> None:
    """What RAUC's own backend for this firmware does: right on a disk with a journal."""
    write_whole(folder / "chooser/autoboot.txt", CHOICE.replace("2", "x").replace("3", "2").replace("x", "3"))
    say("B")


def judge_rename(folder: Path, said: list[str]) -> str:
    path = folder / "chooser/autoboot.txt"
    number = firmware.partition(path.read_bytes() if path.exists() else None)
    if number is None:
        return "no choice"
    return "lost" if said and number != PARTITIONS["B"] else firmware.SLOTS[number]


def with_stick(folder: Path) -> None:
    (folder / "stick").mkdir()


def export(folder: Path, say: Callable[[str], None]) -> None:
    copied(folder / "stick", VISIT, FILES)
    say("out")


def judge_export(folder: Path, said: list[str]) -> str:
    """Under the visit's own name lies the whole of it, or nothing; and it can be exported once more beside it."""
    visit = folder / "stick" / VISIT
    outcome = "new" if visit.exists() else "old"
    found = {path.name: path.read_bytes() for path in visit.iterdir()} if visit.exists() else {}
    assert found in ({}, FILES)
    assert found == FILES or not said
    again = copied(folder / "stick", VISIT, FILES)
    assert {path.name: path.read_bytes() for path in again.iterdir()} == FILES
    return outcome if found or outcome == "old" else "empty"
