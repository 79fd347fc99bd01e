"""Process that takes pictures until it ends: `python -m tests.ports.emulators.victim LEASE_S END CHIP`.

Its phases are those of an exam: aiming in red, a pause, the lit exposure, the dark exposure, the reconstruction. END is
how it ends by itself inside a lit phase: "hang", "raise", "exit", "heir" (killed, while a child holds all its files),
or "never".
"""

import itertools
import os
import signal
import sys
import time

from device.config.head_file import ChainSpec
from device.drivers.guardian import Guardian
from device.drivers.ring import Apa102Ring, LedRing, Tlc5971Ring
from device.values import Illumination
from tests.ports.emulators.wires import SINKS

AIM_S, PAUSE_S, PICTURE_S, MAKE_S = 0.05, 0.02, 0.1, 0.03
ENDS_AT_ROUND = 3


def stop_between_bytecodes(_number: int, _frame: object) -> None:
    """Stop this process, but not within a bus message.

    A real kernel finishes the message first; the emulated bus would serve no other process until this one continues.
    """
    os.kill(os.getpid(), signal.SIGSTOP)


def opened(chip: str, lease_s: float) -> LedRing:
    """Return the ring of a kind of chip on its emulated bus."""
    if chip == "tlc5971":
        return Tlc5971Ring(SINKS, Guardian(SINKS.device, chip="tlc5971"), lease_s)
    chain = ChainSpec()
    return Apa102Ring(chain, Guardian(chain.device, chain.rows * chain.cols), lease_s)


def main(lease_s: float, end: str, chip: str) -> None:
    signal.signal(signal.SIGUSR1, stop_between_bytecodes)
    ring = opened(chip, lease_s)
    os.write(1, b"ready\n")
    for turn in itertools.count():
        for illumination, lit_s, dark_s in (
            (Illumination("red", 0.4), AIM_S, PAUSE_S),
            (Illumination("green"), PICTURE_S, PICTURE_S + MAKE_S),
        ):
            with ring.on(illumination):
                time.sleep(lit_s)
                if turn == ENDS_AT_ROUND and illumination.colour == "green":
                    finish(end)
            time.sleep(dark_s)


def finish(end: str) -> None:
    """Print the moment on the clock that all processes share, and end in the given way with the lamp on."""
    os.write(1, f"ending {time.monotonic()}\n".encode())
    if end == "hang":
        time.sleep(3600)
    if end == "raise":
        raise MemoryError("no room for another picture")
    if end == "exit":
        os._exit(1)
    if end == "heir":
        if os.fork() == 0:
            time.sleep(1)
            os._exit(0)
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2], sys.argv[3])
