"""What a Raspberry Pi 5's firmware makes of `autoboot.txt`, by its documentation: the judge of every power cut.

It reads the first 512 bytes. `[all]` holds for every start, `[tryboot]` for the one that was asked for, and what is
said last counts. Without a file, or without a number, it takes the first partition that is FAT and has a `config.txt`:
on our card that is `boot-a`, whatever is in it.
"""

import re

SLOTS = {2: "A", 3: "B"}
FIRST_BOOTABLE = 2
READS_BYTES = 512


def partition(autoboot: bytes | None, tried: bool = False) -> int | None:
    """The number that `autoboot.txt` names for this start; None if it names none."""
    heard, number = True, None
    for line in (autoboot or b"")[:READS_BYTES].decode("ascii", "replace").splitlines():
        if section := re.fullmatch(r"\[(.+)\]", line):
            heard = section[1] == "all" or (section[1] == "tryboot" and tried)
        elif heard and (said := re.fullmatch(r"boot_partition=(\d+)", line)):
            number = int(said[1])
    return number


def boots(autoboot: bytes | None, tried: bool = False) -> str:
    """The slot that is started."""
    return SLOTS[partition(autoboot, tried) or FIRST_BOOTABLE]
