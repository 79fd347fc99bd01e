"""Guardian: a child process that turns the ring off when a lease of light expires or this process ends."""

import logging
import os
import select
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Literal

from device.drivers.blank import LEDS
from device.errors import LightFault

log = logging.getLogger(__name__)

ANSWER_S = 0.5  # a guardian that answers later would also darken the ring too late
START_S = 10.0  # to start the process on a busy computer, before any light
DARKEN_S = 2.0
BLANK = Path(__file__).with_name("blank.py")


class Guardian:
    """Handle of the child process `blank.py --guard`, which receives leases and acknowledges each.

    `device` is the SPI device, `chip` what its chain is made of, `leds` its length if these are APA102. Every message
    raises LightFault if the child has ended or does not answer within 0.5 s, at its start within 10 s; then no light
    may be turned on.
    """

    def __init__(self, device: str, leds: int = LEDS, chip: Literal["apa102", "tlc5971"] = "apa102") -> None:
        command = [sys.executable, "-I", "-S", str(BLANK), "--device", device, "--leds", str(leds)]
        command += ["--chip", chip, "--guard"]
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True, bufsize=0
        )
        # The kernel frees the memory of a killed process before it closes its pipes: up to 0.4 s with 600 MB on a busy
        # computer. Only the last thread to end frees it, so of two threads at least one ends at once.
        ends = [Thread(target=wait_for_end, args=(self.pid,), name="guardian", daemon=True) for _ in range(2)]
        for thread in ends:
            thread.start()
        if self._send(f"watch {ends[0].native_id} {ends[1].native_id}\n", START_S) != b"ok\n":
            log.info("this kernel is older than Linux 6.9: after a kill the lamp may be dark later on a busy computer")
        if not self.is_real_time:
            log.info("the lamp's guardian has no real-time priority: on a busy computer the lamp may be dark later")

    @property
    def is_real_time(self) -> bool:
        """Return whether the child runs before every ordinary process, which needs a permission (RLIMIT_RTPRIO)."""
        return os.sched_getscheduler(self.pid) == os.SCHED_FIFO

    @property
    def pid(self) -> int:
        """Return the process id of the child."""
        return self._child.pid

    def grant_lease(self, lease_s: float) -> None:
        """Grant a lease of `lease_s` seconds of light from now; acknowledged on return, else LightFault."""
        self._send(f"lit {lease_s:.3f}\n")

    def end_lease(self) -> None:
        """Cancel the lease, after the caller has turned the ring off; LightFault without an acknowledgement."""
        self._send("dark\n")

    def close(self) -> None:
        """End the child, which turns the ring off once more; closing twice is harmless.

        Raises LightFault if the child has not ended within 2 s, because the bus fails; it then continues to retry on
        its own.
        """
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._child.stdin.close()
        self._child.stdout.close()
        try:
            self._child.wait(timeout=DARKEN_S)
        except subprocess.TimeoutExpired as error:
            raise LightFault("the lamp cannot be darkened; its guardian goes on trying") from error

    def __enter__(self) -> "Guardian":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _send(self, words: str, limit_s: float = ANSWER_S) -> bytes:
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        try:
            self._child.stdin.write(words.encode("ascii"))
            ready, _, _ = select.select([self._child.stdout], [], [], limit_s)
            answer = self._child.stdout.read(64) if ready else b""
        except OSError as error:
            raise LightFault(f"the lamp's guardian is gone: {error}") from error
        if not answer:
            raise LightFault("the lamp's guardian does not answer")
        return answer


def wait_for_end(child: int) -> None:
    """Wait until a child process has ended, and leave it to its owner to reap it."""
    with suppress(ChildProcessError):  # it is reaped already
        os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
