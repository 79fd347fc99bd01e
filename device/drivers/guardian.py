"""The other process that darkens the ring: it hears before every light, and acts when this process is gone or hangs."""

import select
import subprocess
import sys
from pathlib import Path
from types import TracebackType

from device.errors import LightFault

ANSWER_S = 0.5  # a guardian that does not answer in that time will not be in time either
BLANK = Path(__file__).with_name("blank.py")


class Guardian:
    """A child that runs `blank.py --guard`: it knows nothing but the bus, and needs nothing but the standard library.

    Raises LightFault where it does not come up, or does not answer; then nothing may shine.
    """

    def __init__(self, device: str, leds: int) -> None:
        command = [sys.executable, "-I", "-S", str(BLANK), "--device", device, "--leds", str(leds), "--guard"]
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True, bufsize=0
        )
        self.dark()

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._child.pid

    def lit(self, lease_s: float) -> None:
        """There will be light, for at most `lease_s` from now. It has answered when this returns."""
        self._tell(f"lit {lease_s:.3f}\n")

    def dark(self) -> None:
        """It is dark."""
        self._tell("dark\n")

    def close(self) -> None:
        """Let it go: it darkens once more and ends; closing twice is harmless."""
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._child.stdin.close()
        self._child.wait(timeout=5)
        self._child.stdout.close()

    def __enter__(self) -> "Guardian":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _tell(self, words: str) -> None:
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        try:
            self._child.stdin.write(words.encode("ascii"))
            ready, _, _ = select.select([self._child.stdout], [], [], ANSWER_S)
            answer = self._child.stdout.read(64) if ready else b""
        except OSError as error:
            raise LightFault(f"the lamp's guardian is gone: {error}") from error
        if not answer:
            raise LightFault("the lamp's guardian does not answer")
