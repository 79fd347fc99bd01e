"""Darken the ring of LEDs, whatever anybody else does: a program of the standard library alone.

    python3 -I -S blank.py --device /dev/spidev0.0            now; for systemd's ExecStopPost= and for every boot
    python3 -I -S blank.py --device /dev/spidev0.0 --guard    when its parent ends, or a lease runs out

The chain keeps its last colour while it has power, so a process that is killed leaves an eye lit. A guard reads leases:
`lit 1.5` (it darkens in 1.5 s unless it hears before), `dark` (nothing to do); it answers each with `ok`. Exit status
1: there is no such device, or it does not listen.
"""

import argparse
import fcntl
import os
import select
import signal
import struct
import sys
from contextlib import suppress

SPEED_HZ = 4_000_000
WR_MODE, WR_MAX_SPEED_HZ = 0x40016B01, 0x40046B04  # <linux/spi/spidev.h>: _IOW('k', 1, u8), _IOW('k', 4, u32)
LEDS = 64
TRIES, AGAIN_S = 200, 0.05


def dark_frame(leds: int) -> bytes:
    """A start of zeros, every LED at full global brightness and no colour, a tail of half a clock for each LED."""
    return bytes(4) + b"\xff\0\0\0" * leds + bytes(max(8, -(-leds // 16)))


def blank(device: str, leds: int) -> None:
    """Send darkness twice, at a speed of our own: the kernel forgets the last user's. Raises OSError."""
    wire = os.open(device, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.ioctl(wire, WR_MODE, struct.pack("=B", 0))
        fcntl.ioctl(wire, WR_MAX_SPEED_HZ, struct.pack("=I", SPEED_HZ))
        frame = dark_frame(leds)
        for _ in range(2):
            if os.write(wire, frame) != len(frame):
                raise OSError(f"{device} took a part of the frame only")
    finally:
        os.close(wire)


def insist(device: str, leds: int) -> None:
    """Darken, again and again while the bus does not listen. Raises OSError when it never does."""
    for _ in range(TRIES):
        with suppress(OSError):
            blank(device, leds)
            return
        select.select([], [], [], AGAIN_S)
    blank(device, leds)


def guard(device: str, leds: int) -> None:
    """Darken when a lease runs out, when standard input ends, or when the parent does though its pipe lives on.

    After a lease has run out it darkens again and again until the parent speaks, which may have been stopped between
    its promise and its light.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with its parent, not before
    ears = select.poll()
    ears.register(0, select.POLLIN)
    ears.register(os.pidfd_open(os.getppid()), select.POLLIN)
    lease_ms: float | None = None  # poll() counts it from the message that began it
    with suppress(BrokenPipeError):  # gone before it heard the answer
        while True:
            heard = {ear for ear, _ in ears.poll(lease_ms)}
            if not heard:
                with suppress(OSError):
                    blank(device, leds)
                lease_ms = 1000 * AGAIN_S
                continue
            said = os.read(0, 4096).decode("ascii") if heard == {0} else ""
            if not said:
                break
            last = said.split("\n")[-2]
            lease_ms = 1000 * float(last.split()[1]) if last.startswith("lit") else None
            os.write(1, b"ok\n")
    (blank if lease_ms is None else insist)(device, leds)


def main() -> int:
    """Do what the words say."""
    parser = argparse.ArgumentParser(description="Darken the ring of LEDs.")
    parser.add_argument("--device", required=True, help="the SPI device, such as /dev/spidev0.0")
    parser.add_argument("--leds", type=int, default=LEDS, help="how many LEDs the chain has")
    parser.add_argument("--guard", action="store_true", help="darken when the parent ends or a lease runs out")
    said = parser.parse_args()
    try:
        (guard if said.guard else blank)(said.device, said.leds)
    except OSError as error:
        sys.stderr.write(f"{said.device} cannot be darkened: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
