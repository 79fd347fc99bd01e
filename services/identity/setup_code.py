"""Set-up code of a label: it creates an administrator or gives one a new PIN, for two minutes, five tries, one use.

That of the device's own console is valid until the next boot or label, as a card without SSH prints no other.
"""

import secrets
from pathlib import Path

from device import atomic_io
from device.clock import Clock, boot_id

FILE, ENDED = "setup-code", "setup-code-ended"
LETTERS, LENGTH = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789", 8  # 40 bits; without I, O, 0 and 1
VALID_S, MAX_TRIES = 120.0, 5
GROUP_READABLE = 0o640  # the group of the folder is that of the server


class SetupCode:
    """Set-up code in a file of `folder`, which another process may replace. Not thread-safe.

    `ended`: folder that keeps which code was used last; None: `folder`, which a server of the image cannot write.
    """

    def __init__(self, folder: Path, clock: Clock, ended: Path | None = None) -> None:
        self._file, self._ended, self._clock = folder / FILE, (ended or folder) / ENDED, clock
        self._tried, self._tries = "", 0

    @property
    def is_of_this_boot(self) -> bool:
        """Whether a code was created since the last boot."""
        return self._file.exists() and self._file.read_text().split()[1] == boot_id()

    def create(self, valid_s: float = VALID_S) -> str:
        """Return a new code, valid for this time, which replaces an earlier one."""
        code = "".join(secrets.choice(LETTERS) for _ in range(LENGTH))
        atomic_io.make_folder(self._file.parent)
        content = f"{code} {boot_id()} {self._clock.now_s() + valid_s}".encode()
        atomic_io.write_atomically(self._file, content, GROUP_READABLE)
        return code

    def is_valid(self, typed: str) -> bool:
        """Return whether `typed`, in any case and with any separators, is the code; each wrong one is a try."""
        content = self._file.read_text() if self._file.exists() else ""
        if content != self._tried:
            self._tried, self._tries = content, 0
        code, boot, until_s = content.split() if content else ("", "", "0")
        if self._ended.exists() and self._ended.read_text() == content:
            return False
        is_open = boot == boot_id() and self._clock.now_s() < float(until_s) and self._tries < MAX_TRIES
        letters = "".join(letter for letter in typed.upper() if letter.isalnum())
        if is_open and secrets.compare_digest(letters.encode(), code.encode()):
            return True
        self._tries += 1
        return False

    def end(self) -> None:
        """End the code that was found valid, also for a restarted server."""
        atomic_io.write_atomically(self._ended, self._tried.encode())
