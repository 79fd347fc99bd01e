"""Client of the systemd watchdog: notifications READY, WATCHDOG (heartbeat), STATUS and STOPPING.

Protocol: sd_notify(3), one datagram per notification to the Unix socket in NOTIFY_SOCKET. Only the thread that owns the
head sends heartbeats; a timer thread would continue to send them while that thread hangs.
"""

import logging
import socket

log = logging.getLogger(__name__)

BEAT_S = 2.0  # longest interval of heartbeats while idle; WatchdogSec of the unit is fifteen times as long


class Watchdog:
    """Notification sender for the Unix socket `address`; a leading `@` means the abstract namespace.

    With `address` None (no systemd) every method is a no-op.
    """

    def __init__(self, address: str | None) -> None:
        self._address = address.replace("@", "\0", 1) if address and address.startswith("@") else address

    def ready(self) -> None:
        """Send READY (start-up complete); systemd expects heartbeats from now on."""
        self._notify("READY=1")

    def beat(self) -> None:
        """Send one heartbeat."""
        self._notify("WATCHDOG=1")

    def status(self, sentence: str) -> None:
        """Send a status line for `systemctl status`; line breaks become spaces."""
        self._notify(f"STATUS={' '.join(sentence.split())}")

    def stopping(self) -> None:
        """Send STOPPING before a regular shutdown."""
        self._notify("STOPPING=1")

    def _notify(self, line: str) -> None:
        """Send one datagram without blocking; log a failure and continue. No-op without an address."""
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as client:
                client.sendto(line.encode(), self._address)
        except OSError as error:
            log.warning("sd_notify failed for %s: %s", line, error)
