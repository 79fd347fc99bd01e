"""The guardian: a small process of its own that makes the LED chain dark when this one dies, hangs or is stopped."""

import math
import os
import select
import socket
import subprocess
import sys
from contextlib import suppress

from device.drivers import blank
from device.errors import LightFault

ANSWER_S = 0.5  # a guardian that takes longer is not one

_GONE = "The safety part of the lamp has stopped. Turn the device off and on."


class Guardian:
    """Runs `blank.py --watch` beside us and tells it until when the lamp may be lit.

    A fresh interpreter, not a bare fork: it shares no memory, thread, lock or open file with a process that fails.
    Raises LightFault if it does not answer within half a second, here or when a lease begins.
    """

    def __init__(self, device: str, leds: int = 64) -> None:
        self._door, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.was_cut = False
        command = [
            sys.executable, "-I", "-S", blank.__file__, "--device", device, "--leds", str(leds),
            "--watch", str(theirs.fileno()), "--owner", str(os.getpid()),
        ]  # fmt: skip
        with theirs:
            self._child = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
        self._answer(10 * ANSWER_S)  # an interpreter starts

    @property
    def pid(self) -> int:
        """Its process."""
        return self._child.pid

    def lit(self, lease_s: float) -> None:
        """Before light: darken it in `lease_s` seconds unless told otherwise; LightFault if nobody listens."""
        self.notice()
        try:
            self._door.send(b"lit %d" % math.ceil(lease_s * 1000), socket.MSG_DONTWAIT)
        except OSError as error:
            raise LightFault(f"the lamp's guardian does not listen: {error}", _GONE) from error
        self._answer()
        self.was_cut = False

    def dark(self) -> None:
        """After darkness: no lease runs. If nobody listens there is nothing to end."""
        with suppress(OSError):
            self._door.send(b"dark", socket.MSG_DONTWAIT)

    def notice(self) -> bool:
        """Whether the guardian ended the present lease by itself."""
        with suppress(OSError):  # nothing was said, or nobody is there
            while said := self._door.recv(64, socket.MSG_DONTWAIT):
                self.was_cut |= said == b"cut"
        return self.was_cut

    def close(self) -> None:
        """Let it go: it darkens the chain once more and ends. Closing twice is harmless."""
        with suppress(OSError):
            self._door.send(b"quit", socket.MSG_DONTWAIT)
        self._door.close()
        try:
            self._child.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def _answer(self, within_s: float = ANSWER_S) -> None:
        try:
            while select.select([self._door], [], [], within_s)[0] and (said := self._door.recv(64)):
                if said == b"ok":
                    return
        except OSError as error:
            raise LightFault(f"the lamp's guardian does not answer: {error}", _GONE) from error
        raise LightFault("the lamp's guardian does not answer", _GONE)
