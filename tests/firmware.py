"""Emulated Raspberry Pi 5 firmware: boot partition selection from `autoboot.txt`, as its documentation specifies.

It reads the first 512 bytes. `[all]` applies to every boot, `[tryboot]` to a boot with the tryboot argument, and the
last value wins. Without a file or a number, it takes the first FAT partition with a `config.txt`: on our card `boot-a`,
whatever its content.
"""

import re

SLOTS = {2: "A", 3: "B"}
FIRST_BOOTABLE = 2
READS_BYTES = 512


def partition(autoboot: bytes | None, tried: bool = False) -> int | None:
    """Return the partition number that `autoboot.txt` selects for this boot; None if it selects none."""
    applies, number = True, None
    for line in (autoboot or b"")[:READS_BYTES].decode("ascii", "replace").splitlines():
        if section := re.fullmatch(r"\[(.+)\]", line):
            applies = section[1] == "all" or (section[1] == "tryboot" and tried)
        elif applies and (setting := re.fullmatch(r"boot_partition=(\d+)", line)):
            number = int(setting[1])
    return number


def boots(autoboot: bytes | None, tried: bool = False) -> str:
    """Return the slot that boots."""
    return SLOTS[partition(autoboot, tried) or FIRST_BOOTABLE]
