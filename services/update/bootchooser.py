#!/usr/bin/python3 -IS
"""Which slot a Raspberry Pi boots: RAUC's custom boot chooser over `autoboot.txt` and tryboot.

    autoboot.txt   [all] names the committed slot, which every boot takes; [tryboot] the other one
    tryboot        a word given to the firmware with an orderly restart: it boots [tryboot], once

So a slot is tried once. If nobody commits it, the next boot is the committed one again, whatever happened.
`autoboot.txt` is written when a tried slot is committed, and never else. It lies on FAT, which has no journal, and the
firmware has no second one: so its two numbers are swapped where they stand, in the file's one sector, and nothing else
of that filesystem is touched. Standard library only: it must work where the release does not.
"""

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

PARTITIONS = {"A": 2, "B": 3}  # of the boot partitions; the first one holds autoboot.txt and nothing else
SLOTS = {number: slot for slot, number in PARTITIONS.items()}
TRY = "0 tryboot\n"
SECTOR_BYTES = 512  # what a disk writes as one, and all that the firmware reads of autoboot.txt
CHOICE = re.compile(
    rb"([^[]*\[all\]\s[^[]*\nboot_partition=)([23])(\s[^[]*\[tryboot\]\s+boot_partition=)([23])((?:\s[^[]*)?)"
)


@dataclass(frozen=True)
class BootChooser:
    """The choice and where it is kept; `autoboot` is the file, `state` a folder that both slots see.

    `reboot_word` is the file whose line systemd hands to the firmware with a restart; it is gone after every boot, and
    so is the wish to try. `command_line` is the kernel's: `rauc.slot=` says which slot was booted.
    """

    autoboot: Path = Path("/boot/chooser/autoboot.txt")
    state: Path = Path("/var/lib/diffuscope-update")
    reboot_word: Path = Path("/run/systemd/reboot-param")
    command_line: Path = Path("/proc/cmdline")

    def booted(self) -> str:
        """The slot that runs; ValueError if the kernel was not told."""
        words = self.command_line.read_text().split()
        slot = next((word.removeprefix("rauc.slot=") for word in words if word.startswith("rauc.slot=")), "")
        if slot not in PARTITIONS:
            raise ValueError(f"{self.command_line} does not say rauc.slot=A or rauc.slot=B")
        return slot

    def committed(self) -> str:
        """The slot that every boot takes which is not a try; ValueError if `autoboot.txt` does not say."""
        return SLOTS[int(self._choice()[2])]

    def is_trying(self) -> bool:
        """Whether the slot that runs has yet to be committed."""
        return self.booted() != self.committed()

    def primary(self) -> str:
        """The slot that an orderly restart would boot now."""
        wanted = self.reboot_word.read_text() if self.reboot_word.exists() else ""
        return other(self.committed()) if wanted == TRY else self.committed()

    def set_primary(self, slot: str) -> None:
        """RAUC's last step of an install: the slot is whole. The committed slot is chosen by taking a try back."""
        self._bad(slot).unlink(missing_ok=True)
        if slot == self.committed():
            self.reboot_word.unlink(missing_ok=True)
        elif slot == self.booted():
            self._commit(slot)
        else:
            write_whole(self.reboot_word, TRY)

    def is_good(self, slot: str) -> bool:
        """False for a slot whose install was begun and not finished, or that was tried and did not do."""
        return not self._bad(slot).exists()

    def set_good(self, slot: str) -> None:
        """Of a slot that is being tried: commit it."""
        self._bad(slot).unlink(missing_ok=True)
        if slot == self.booted() and slot != self.committed():
            self._commit(slot)

    def set_bad(self, slot: str) -> None:
        """RAUC's first step of an install; ValueError for the committed slot, which nobody may overwrite."""
        if slot == self.committed():
            raise ValueError(f"slot {slot} is the committed one: every boot that is not a try needs it")
        write_whole(self._bad(slot), "")

    def _bad(self, slot: str) -> Path:
        return self.state / f"slot-{slot.lower()}-is-bad"

    def _choice(self) -> re.Match[bytes]:
        said = self.autoboot.read_bytes()
        choice = CHOICE.fullmatch(said)
        if choice is None or len(said) > SECTOR_BYTES:
            raise ValueError(f"{self.autoboot} does not say which slot is committed: {said[:SECTOR_BYTES]!r}")
        return choice

    def _commit(self, slot: str) -> None:
        """Same file, same length, one sector: whatever a power cut leaves of this names a slot that works."""
        choice = self._choice()
        now, next_try = (str(PARTITIONS[one]).encode() for one in (slot, other(slot)))
        descriptor = os.open(self.autoboot, os.O_WRONLY)
        try:
            os.pwrite(descriptor, choice[1] + now + choice[3] + next_try + choice[5], 0)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def other(slot: str) -> str:
    """The slot beside `slot`."""
    return "B" if slot == "A" else "A"


def write_whole(path: Path, content: str) -> None:
    """The file is the old one or the new one, also after a power cut; not on FAT."""
    part = path.with_name(f"{path.name}.part")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    try:
        os.write(descriptor, content.encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    part.rename(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def main(words: list[str], chooser: BootChooser) -> int:
    """Answer RAUC (get-primary, set-primary, get-state, set-state) or systemd (`trying`); the exit status."""
    try:
        match words:
            case ["get-primary"]:
                sys.stdout.write(f"{chooser.primary()}\n")
            case ["set-primary", ("A" | "B") as slot]:
                chooser.set_primary(slot)
            case ["get-state", ("A" | "B") as slot]:
                sys.stdout.write("good\n" if chooser.is_good(slot) else "bad\n")
            case ["set-state", ("A" | "B") as slot, "good"]:
                chooser.set_good(slot)
            case ["set-state", ("A" | "B") as slot, "bad"]:
                chooser.set_bad(slot)
            case ["trying"]:
                return 0 if chooser.is_trying() else 1
            case _:
                raise ValueError(f"bootchooser does not know {' '.join(words)!r}")
    except (OSError, ValueError) as error:
        sys.stderr.write(f"bootchooser: {error}\n")
        return 254
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], BootChooser()))
