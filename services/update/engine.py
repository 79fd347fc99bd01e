"""RAUC, as the updater sees it: what a bundle says of itself, install, mark; its words become our errors."""

import json
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from device.errors import UpdateDamaged, UpdateError, UpdateFailed, UpdateForeign, UpdateNoRoom

QUESTION_S = 120.0  # a whole bundle is read from a slow card to check its signature
_UNTRUSTED = re.compile(r"Verify error|unsupported certificate purpose|self.signed")
_BROKEN = re.compile(r"signature verification failed|Invalid bundle|content verify error|bad signature")
_TOO_LARGE = re.compile(r"too small|No space left|exceeds")


@dataclass(frozen=True)
class Release:
    """What a bundle whose signature holds says of itself.

    `minimum` is the oldest version that may become it; `has_kernel` says that it writes a slot's boot partition too.
    """

    compatible: str
    version: str
    minimum: str
    build: str
    has_kernel: bool = False


class Rauc:
    """The program `rauc`, with the words by which it is called."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words = tuple(words)

    def release(self, bundle: Path) -> Release:
        """What is in a bundle; UpdateForeign or UpdateDamaged if it is not a bundle that we trust."""
        said = json.loads(self._ask("info", "--output-format=json", str(bundle)))
        minimum = re.search(r"from (\S+) or newer", said["description"] or "")
        return Release(
            said["compatible"], said["version"], minimum[1] if minimum else "0", said["build"] or "",
            any("boot" in image for image in said["images"]),
        )  # fmt: skip

    def compatible(self) -> str:
        """The kind of device that this is."""
        return str(json.loads(self._ask("status", "--output-format=json"))["compatible"])

    def install(self, bundle: Path, progress: Callable[[float, str], None]) -> None:
        """Write a bundle into the slot that does not run; UpdateFailed with RAUC's last words if it cannot.

        `progress` hears shares from 0 to 1 with what is done.
        """
        said: list[str] = []
        words = [*self._words, "install", str(bundle)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
            assert running.stdout is not None
            for line in running.stdout:
                said.append(line.strip())
                if step := re.match(r"\s*(\d+)% (.+)", line):
                    progress(int(step[1]) / 100, step[2].strip())
        if running.returncode != 0:
            raise self._error("\n".join(said))

    def mark(self, how: str, slot: str = "booted") -> None:
        """Mark a slot `good`, which commits it, `bad`, or `active`, which tries it at the next restart."""
        self._ask("status", f"mark-{how}", slot)

    def _ask(self, *words: str) -> str:
        try:
            done = subprocess.run([*self._words, *words], capture_output=True, text=True, timeout=QUESTION_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UpdateFailed(f"RAUC cannot be asked: {error}") from error
        if done.returncode != 0:
            raise self._error(done.stderr + done.stdout)
        return done.stdout

    @staticmethod
    def _error(said: str) -> UpdateError:
        last = re.findall(r"LastError: (.+)", said) or [line for line in said.splitlines() if line.strip()][-1:]
        message = f"RAUC says: {last[0]}" if last else "RAUC says nothing"
        if _UNTRUSTED.search(said):
            return UpdateForeign(message)
        if _BROKEN.search(said):
            return UpdateDamaged(message)
        return UpdateNoRoom(message) if _TOO_LARGE.search(said) else UpdateFailed(message)
