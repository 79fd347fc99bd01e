"""Set-up code of a label: it lets the first administrator be created, for two minutes and five tries."""

import secrets
from pathlib import Path

from device import atomic_io
from device.clock import Clock, boot_id

FILE = "setup-code"
LETTERS, LENGTH = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789", 8  # 40 bits; without I, O, 0 and 1
VALID_S, MAX_TRIES = 120.0, 5
GROUP_READABLE = 0o640  # the group of the folder is that of the server


class SetupCode:
    """Set-up code in a file of `folder`, which another process may replace. Not thread-safe."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file, self._clock = folder / FILE, clock
        self._tried, self._tries = "", 0

    def create(self) -> str:
        """Return a new code, which replaces an earlier one."""
        code = "".join(secrets.choice(LETTERS) for _ in range(LENGTH))
        atomic_io.make_folder(self._file.parent)
        content = f"{code} {boot_id()} {self._clock.now_s()}".encode()
        atomic_io.write_atomically(self._file, content, GROUP_READABLE)
        return code

    def is_valid(self, typed: str) -> bool:
        """Return whether `typed`, in any case and with any separators, is the code; each wrong one is a try."""
        content = self._file.read_text() if self._file.exists() else ""
        if content != self._tried:
            self._tried, self._tries = content, 0
        code, boot, created_s = content.split() if content else ("", "", "0")
        is_open = boot == boot_id() and self._clock.now_s() - float(created_s) < VALID_S and self._tries < MAX_TRIES
        letters = "".join(letter for letter in typed.upper() if letter.isalnum())
        if is_open and secrets.compare_digest(letters.encode(), code.encode()):
            return True
        self._tries += 1
        return False
