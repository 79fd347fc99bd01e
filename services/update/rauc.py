"""RAUC client: bundle information, install and slot marks; RAUC's messages are mapped to errors of this project."""

import json
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from services.errors import UpdateDamaged, UpdateError, UpdateFailed, UpdateNoRoom, UpdateUntrusted

COMMAND_TIMEOUT_S = 120.0  # checking a signature reads the whole bundle from a slow card
_UNTRUSTED = re.compile(r"Verify error|unsupported certificate purpose|self.signed")
_BROKEN = re.compile(r"signature verification failed|Invalid bundle|content verify error|bad signature")
_TOO_LARGE = re.compile(r"too small|No space left|exceeds")


@dataclass(frozen=True)
class Release:
    """Metadata of a bundle with a valid signature.

    `compatible` is its device type; `minimum` the oldest version that may install it ("0": any); `has_kernel` is True
    if it also contains a boot partition.
    """

    compatible: str
    version: str
    minimum: str
    build: str
    has_kernel: bool = False


class Rauc:
    """Client of the program `rauc`; `words` are its command and the options before the subcommand."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words = tuple(words)

    def release(self, bundle: Path) -> Release:
        """Return the metadata of a bundle; UpdateUntrusted or UpdateDamaged if its signature or content is invalid.

        UpdateFailed if RAUC does not run.
        """
        info = json.loads(self._ask("info", "--output-format=json", str(bundle)))
        minimum = re.search(r"from (\S+) or newer", info["description"] or "")
        return Release(
            info["compatible"],
            info["version"],
            minimum[1] if minimum else "0",
            info["build"] or "",
            any("boot" in image for image in info["images"]),
        )

    def compatible(self) -> str:
        """Return the device type of this system (RAUC's `compatible`)."""
        return str(json.loads(self._ask("status", "--output-format=json"))["compatible"])

    def install(self, bundle: Path, progress: Callable[[float, str], None]) -> None:
        """Write a bundle into the inactive slot; `progress` is called with the share done (0 to 1) and RAUC's step.

        On failure UpdateUntrusted, UpdateDamaged, UpdateNoRoom or UpdateFailed, with RAUC's last message.
        """
        output: list[str] = []
        command = [*self._words, "install", str(bundle)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
            assert running.stdout is not None
            for line in running.stdout:
                output.append(line.strip())
                if step := re.match(r"\s*(\d+)% (.+)", line):
                    progress(int(step[1]) / 100, step[2].strip())
        if running.returncode != 0:
            raise self._error("\n".join(output))

    def mark(self, how: str, slot: str = "booted") -> None:
        """Mark a slot ("booted", "other") `good` (commits it), `bad`, or `active` (tries it at the next reboot)."""
        self._ask("status", f"mark-{how}", slot)

    def _ask(self, *words: str) -> str:
        try:
            done = subprocess.run([*self._words, *words], capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UpdateFailed(f"RAUC cannot be asked: {error}") from error
        if done.returncode != 0:
            raise self._error(done.stderr + done.stdout)
        return done.stdout

    @staticmethod
    def _error(output: str) -> UpdateError:
        last = re.findall(r"LastError: (.+)", output) or [line for line in output.splitlines() if line.strip()][-1:]
        message = f"RAUC says: {last[0]}" if last else "RAUC says nothing"
        if _UNTRUSTED.search(output):
            return UpdateUntrusted(message)
        if _BROKEN.search(output):
            return UpdateDamaged(message)
        return UpdateNoRoom(message) if _TOO_LARGE.search(output) else UpdateFailed(message)
