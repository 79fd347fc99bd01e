"""Files that come from others: lists of a folder without hidden companions, text in UTF-8, files of limited size.

macOS writes a companion `._NAME` (AppleDouble, RFC 1740) beside each file on FAT, exFAT and network drives, and drives
get hidden folders such as `.Trashes`: no list of this module has them.
"""

import codecs
import io
import os
import stat
from pathlib import Path

from device.errors import SpecError

APPLE_DOUBLE = b"\x00\x05\x16\x07"
OPEN_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # no link is followed, no pipe waited for
UTF8_REMEDY = "Save the file again as UTF-8: most editors have the encoding under Save as."
_WIDE_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE)  # that of UTF-32 LE begins as UTF-16 LE


def files_in(folder: Path, *patterns: str) -> list[Path]:
    """Return the files and folders that match one of the glob patterns, sorted, without hidden ones.

    Hidden: the name, or that of a folder between `folder` and it, begins with a dot. Without a pattern: all that is
    directly in `folder`. OSError of a folder that cannot be read.
    """
    found = {path for pattern in patterns for path in folder.glob(pattern)} if patterns else set(folder.iterdir())
    return sorted(path for path in found if not is_hidden(path, folder))


def is_hidden(path: Path, folder: Path) -> bool:
    """Return whether the name of a path below `folder`, or of a folder between them, begins with a dot."""
    return any(part.startswith(".") for part in path.relative_to(folder).parts)


def read_plain_file(path: Path, most_bytes: int) -> bytes:
    """Return the content of a regular file, at most `most_bytes`; OSError for any other, a link or a longer file."""
    with io.FileIO(os.open(path, OPEN_FLAGS), closefd=True) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(0, "it is no plain file")
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(0, f"it is longer than {most_bytes} bytes")
    return content


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, with or without a byte-order mark.

    SpecError for a file that cannot be read, and as of `decoded_text`.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror}", "Give the path of a readable file.") from error
    return decoded_text(content, str(path))


def decoded_text(content: bytes, name: str) -> str:
    """Return text in UTF-8, with or without a byte-order mark; `name` is the name of the file in errors.

    SpecError, each with its own reason: a companion of macOS, UTF-16, zero bytes, another encoding such as Latin-1.
    """
    if content.startswith(APPLE_DOUBLE):
        remedy = "Give the file of the same name without ._ at its beginning."
        raise SpecError(f"{name} is a hidden companion that macOS wrote, not the file itself", remedy)
    if content.startswith(_WIDE_MARKS) or _is_wide(content):
        raise SpecError(f"{name} is saved as UTF-16, not as UTF-8", UTF8_REMEDY)
    if b"\0" in content:
        raise SpecError(f"{name} has zero bytes, so it is no text", "Copy the file again, or write it again.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        reason = f"the byte 0x{content[error.start]:02X} is not UTF-8, as in a file saved as Latin-1 or Windows-1252"
        raise SpecError(f"{name}, line {line}: {reason}", UTF8_REMEDY) from error


def _is_wide(content: bytes) -> bool:
    """Return whether each second byte of the beginning is zero, as in Latin letters of UTF-16 without a mark."""
    start = content[:64]
    return len(start) >= 4 and any(not any(start[at::2]) and all(start[1 - at :: 2]) for at in (0, 1))
