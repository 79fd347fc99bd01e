#!/usr/bin/python3 -IS
"""Boot slot selection on a Raspberry Pi: RAUC's custom boot chooser over `autoboot.txt` and tryboot.

    autoboot.txt   [all] names the committed slot, used by every normal boot; [tryboot] names the other slot
    tryboot        reboot argument for the firmware: it boots [tryboot] once

A slot ("A" or "B") is an operating system with its boot partition. The uncommitted slot is tried for one boot: without
a commit the next boot uses the committed slot again. `autoboot.txt` is written at a commit only. It is on FAT, which
has no journal, and the firmware reads no second file: so the commit swaps its two numbers in place, in the file's only
sector, and changes nothing else on that file system. Standard library only: this program must run when the release does
not.
"""

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

PARTITIONS = {"A": 2, "B": 3}  # boot partitions; partition 1 holds autoboot.txt only
SLOTS = {number: slot for slot, number in PARTITIONS.items()}
TRYBOOT_ARGUMENT = "0 tryboot\n"
SECTOR_BYTES = 512  # unit of an atomic disk write; the firmware reads no more of autoboot.txt
AUTOBOOT_FORMAT = re.compile(
    rb"([^[]*\[all\]\s[^[]*\nboot_partition=)([23])(\s[^[]*\[tryboot\]\s+boot_partition=)([23])((?:\s[^[]*)?)"
)


@dataclass(frozen=True)
class BootChooser:
    """Slot selection and its files: `autoboot` is autoboot.txt, `state` the shared folder of the bad marks.

    `reboot_argument` is the file whose line systemd passes to the firmware at a reboot; it is on a tmpfs, so the
    request to try a slot ends with each boot. `command_line` is the kernel's: `rauc.slot=` names the booted slot.
    """

    autoboot: Path = Path("/boot/chooser/autoboot.txt")
    state: Path = Path("/var/lib/diffuscope-update")
    reboot_argument: Path = Path("/run/systemd/reboot-param")
    command_line: Path = Path("/proc/cmdline")

    def booted(self) -> str:
        """Return the running slot, "A" or "B"; ValueError if the kernel command line does not name it."""
        words = self.command_line.read_text().split()
        slot = next((word.removeprefix("rauc.slot=") for word in words if word.startswith("rauc.slot=")), "")
        if slot not in PARTITIONS:
            raise ValueError(f"{self.command_line} does not say rauc.slot=A or rauc.slot=B")
        return slot

    def committed(self) -> str:
        """Return the slot of every normal boot, "A" or "B"; ValueError if `autoboot.txt` is invalid."""
        return SLOTS[int(self._choice()[2])]

    def is_trying(self) -> bool:
        """Return whether the running slot is not yet committed."""
        return self.booted() != self.committed()

    def primary(self) -> str:
        """Return the slot of the next orderly reboot: the other slot if a try is requested, else the committed one."""
        wanted = self.reboot_argument.read_text() if self.reboot_argument.exists() else ""
        return other(self.committed()) if wanted == TRYBOOT_ARGUMENT else self.committed()

    def set_primary(self, slot: str) -> None:
        """Clear the bad mark of a slot and select it for the next boot; RAUC's last step of an install.

        The committed slot: cancel a requested try. The running, uncommitted slot: commit it. Otherwise: request a try.
        """
        self._bad(slot).unlink(missing_ok=True)
        if slot == self.committed():
            self.reboot_argument.unlink(missing_ok=True)
        elif slot == self.booted():
            self._commit(slot)
        else:
            write_atomically(self.reboot_argument, TRYBOOT_ARGUMENT)

    def is_good(self, slot: str) -> bool:
        """Return whether the slot has no bad mark; the mark means an unfinished install or a failed try."""
        return not self._bad(slot).exists()

    def set_good(self, slot: str) -> None:
        """Clear the bad mark of a slot; if it is the running, uncommitted slot, commit it."""
        self._bad(slot).unlink(missing_ok=True)
        if slot == self.booted() and slot != self.committed():
            self._commit(slot)

    def set_bad(self, slot: str) -> None:
        """Set the bad mark of a slot (also RAUC's first step of an install); ValueError for the committed slot."""
        if slot == self.committed():
            raise ValueError(f"slot {slot} is the committed one: every boot that is not a try needs it")
        write_atomically(self._bad(slot), "")

    def _bad(self, slot: str) -> Path:
        return self.state / f"slot-{slot.lower()}-is-bad"

    def _choice(self) -> re.Match[bytes]:
        content = self.autoboot.read_bytes()
        choice = AUTOBOOT_FORMAT.fullmatch(content)
        if choice is None or len(content) > SECTOR_BYTES:
            raise ValueError(f"{self.autoboot} does not say which slot is committed: {content[:SECTOR_BYTES]!r}")
        return choice

    def _commit(self, slot: str) -> None:
        """Make `slot` the committed one: write both partition numbers of autoboot.txt in place.

        Length and sector stay the same, so that the file names a working slot after a power cut.
        """
        choice = self._choice()
        now, next_try = (str(PARTITIONS[name]).encode() for name in (slot, other(slot)))
        descriptor = os.open(self.autoboot, os.O_WRONLY)
        try:
            os.pwrite(descriptor, choice[1] + now + choice[3] + next_try + choice[5], 0)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def other(slot: str) -> str:
    """Return the other of the two slots."""
    return "B" if slot == "A" else "A"


def write_atomically(path: Path, content: str) -> None:
    """Write a file atomically: after a power cut it has the old or the new content. Not safe on FAT."""
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
    """Run one command of RAUC (get-primary, set-primary, get-state, set-state) or systemd (`trying`).

    Return the exit status: 0, 1 (`trying`: the slot is committed), or 254 after an error message.
    """
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
