"""Companions that macOS writes beside each file on FAT, exFAT and network drives."""

import struct
from pathlib import Path


def apple_double() -> bytes:
    """Return the content of a companion (RFC 1740): Finder info (id 9) and an empty resource fork (id 2)."""
    head = struct.pack(">II16sH", 0x00051607, 0x00020000, b"Mac OS X        ", 2)
    return (head + struct.pack(">IIIIII", 9, 50, 3760, 2, 3810, 286)).ljust(4096, b"\0")


def add_companions(folder: Path) -> int:
    """Write a companion beside each file below a folder, and the folders that macOS makes; return their number."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    for path in files:
        path.with_name(f"._{path.name}").write_bytes(apple_double())
    (folder / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (folder / ".Trashes/501").mkdir(parents=True)
    return len(files)
