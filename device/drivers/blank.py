"""The last line: makes the LED chain dark with nothing but the standard library.

`python3 -I -S blank.py --device /dev/spidev0.0` darkens it once: for `ExecStopPost=` and before the first start.
With `--watch FD --owner PID` it is the guardian: it darkens when its owner dies, or when a lease runs out.
It imports nothing of ours, so that it still works when nothing of ours does.
"""

import argparse
import errno
import fcntl
import os
import select
import signal
import socket
import struct
import sys
from contextlib import suppress

SPEED_HZ = 4_000_000  # the Pi's default is 125 MHz, and the driver returns to it on the last close: set it every time
SPI_IOC_WR_MODE, SPI_IOC_WR_MAX_SPEED_HZ = 0x40016B01, 0x40046B04
AGAIN_MS = 50  # how soon darkness is said again to an owner that hangs, or to a bus that fails
TRIES = 100  # for an owner that is dead: five seconds


def blank_frame(leds: int = 64) -> bytes:
    """The bytes that make `leds` LEDs dark: 32 zero bits, each LED at full global brightness and no colour, zeros.

    Half a clock is lost at each LED, and the SK9822 wants 32 zeros more: the tail covers both.
    """
    return bytes(4) + b"\xff\0\0\0" * leds + bytes(4 + -(-leds // 16))


def blank(device: str, leds: int = 64) -> None:
    """Make the chain dark, twice, at our own mode and speed; OSError if the bus does not take it."""
    frame = blank_frame(leds)
    wire = os.open(device, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.ioctl(wire, SPI_IOC_WR_MODE, b"\0")
        fcntl.ioctl(wire, SPI_IOC_WR_MAX_SPEED_HZ, struct.pack("=I", SPEED_HZ))
        for _ in range(2):
            if os.write(wire, frame) != len(frame):
                raise OSError(errno.EIO, "the bus cut the frame short")
    finally:
        os.close(wire)


def insist(device: str, leds: int) -> bool:
    """Make the chain dark although the bus may fail for a while; whether it worked."""
    for _ in range(TRIES):
        with suppress(OSError):
            blank(device, leds)
            return True
        select.select([], [], [], AGAIN_MS / 1000)
    return False


def watch(device: str, leds: int, door: socket.socket, owner: int) -> bool:
    """Be the guardian until the owner dies or says "quit", and leave darkness behind; whether that worked.

    The owner says "lit N" (for at most N ms from now), "dark" or "quit"; "lit" is answered with "ok". Once a lease has
    run out, the chain is darkened again and again until the owner speaks: it may have been stopped while it lit up.
    """
    gone = os.pidfd_open(owner)
    ears = select.poll()
    ears.register(gone, select.POLLIN)
    ears.register(door, select.POLLIN)
    left_ms: int | None = None
    if os.getppid() == owner:
        door.send(b"ok")
        while True:
            heard = {ear for ear, _ in ears.poll(left_ms)}
            if gone in heard:
                break
            if not heard:
                left_ms = AGAIN_MS
                with suppress(OSError):
                    blank(device, leds)
                    door.send(b"cut", socket.MSG_DONTWAIT)
                continue
            said = _heard(door)
            if said in (b"", b"quit"):
                break
            left_ms = int(said[4:]) if said.startswith(b"lit ") else None
            if left_ms is not None:
                with suppress(OSError):  # a dead owner is seen on the next round
                    door.send(b"ok", socket.MSG_DONTWAIT)
    return insist(device, leds)


def _heard(door: socket.socket) -> bytes:
    """What the owner says; nothing if it is gone."""
    try:
        return door.recv(64)
    except ConnectionError:
        return b""


def main() -> int:
    """Darken once, or watch."""
    parser = argparse.ArgumentParser(description="Make the LED chain dark.")
    parser.add_argument("--device", default="/dev/spidev0.0")
    parser.add_argument("--leds", type=int, default=64)
    parser.add_argument("--watch", type=int, help="socket to the owner, for a guardian")
    parser.add_argument("--owner", type=int, help="process whose death means darkness")
    asked = parser.parse_args()
    if asked.watch is None:
        try:
            blank(asked.device, asked.leds)
        except OSError as error:
            print(f"the light could not be darkened: {asked.device}: {error}", file=sys.stderr)  # noqa: T201
            return 1
        return 0
    for deaf in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(deaf, signal.SIG_IGN)  # who stops the instrument must not stop its guardian first
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    with socket.socket(fileno=asked.watch) as door:
        return 0 if watch(asked.device, asked.leds, door, asked.owner) else 1


if __name__ == "__main__":
    sys.exit(main())
