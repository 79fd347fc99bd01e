"""What systemd is told: that the instrument is ready, that it lives, what it does, that it ends.

The protocol of sd_notify(3): lines in a datagram to a socket that systemd names. A beat says that its caller lives:
only the loop that owns the head may say so, never a timer, which would go on beating for a loop that hangs.
"""

import logging
import socket

log = logging.getLogger(__name__)

BEAT_S = 2.0  # at least this often while there is nothing to do; the unit's WatchdogSec is five times that


class Watchdog:
    """The one who waits for signs of life at `address`; None, where nobody waits, and every word is lost."""

    def __init__(self, address: str | None) -> None:
        self._address = address.replace("@", "\0", 1) if address and address.startswith("@") else address

    def ready(self) -> None:
        """Everything is prepared: from now on the beats count."""
        self._tell("READY=1")

    def beat(self) -> None:
        """The caller lives."""
        self._tell("WATCHDOG=1")

    def status(self, sentence: str) -> None:
        """What it does, in one line for `systemctl status`."""
        self._tell(f"STATUS={' '.join(sentence.split())}")

    def stopping(self) -> None:
        """It ends of its own will."""
        self._tell("STOPPING=1")

    def _tell(self, line: str) -> None:
        """Sent or lost, never waited for: systemd draws its own conclusion from silence."""
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as speaker:
                speaker.sendto(line.encode(), self._address)
        except OSError as error:
            log.warning("systemd does not hear %s: %s", line, error)
