"""Stand-alone program that turns the ring of LEDs off, APA102 or TLC5971, with the standard library only.

    python3 -I -S blank.py --device /dev/spidev0.0            now; for systemd's ExecStopPost=
    python3 -I -S blank.py --device /dev/spidev0.0 --insist   for every boot: again for 10 s if the bus fails
    python3 -I -S blank.py --device /dev/spidev0.0 --guard    when its parent ends, or a lease expires

The chain keeps its last colour while it has power, so a killed process leaves the LEDs on. The guard reads leases from
standard input: `lit 1.5` (turn off in 1.5 s unless a new lease arrives), `dark` (no lease), `watch 12 13` (threads
of its parent, whose end is the parent's); it answers each with `ok`, or `old` on a kernel that cannot watch threads.
Without --chip the messages of both kinds are sent, that of the TLC5971 first: these chips ignore the other one, which
has no write command where a packet begins. A matrix of APA102 receives its own message last.
Exit status 1: the device does not exist, or does not accept the frame.
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
MAX_SINKS = 4  # a shorter chain of TLC5971 shifts the packets of absent chips out
TRIES = 200
AGAIN_S = 0.05
MCL_CURRENT = 1  # <sys/mman.h>
MIN_NICE = -20
PIDFD_THREAD = os.O_EXCL  # <linux/pidfd.h>


def dark_frame(leds: int) -> bytes:
    """Return the off frame: 4 zero bytes, per LED zero colour at full global brightness, trailing zeros as clocks."""
    # 0xff is 0b111 and brightness 31: smaller ones add a second, slow PWM that beats with the exposure.
    return bytes(4) + b"\xff\0\0\0" * leds + bytes(max(8, -(-leds // 16)))


def dark_packets(chips: int) -> bytes:
    """Return the off message of a chain of TLC5971: write command 25h, blanked, brightness and grey scales 0."""
    return (b"\x94\x20" + bytes(26)) * chips


def off_frames(chip: str, leds: int) -> list[bytes]:
    """Return the messages that turn a chain off, each twice; for the chip "any" those of both kinds."""
    sinks = [dark_packets(MAX_SINKS)] * 2
    matrix = [dark_frame(leds)] * 2
    return {"apa102": matrix, "tlc5971": sinks, "any": sinks + matrix}[chip]


def blank(device: str, leds: int, chip: str) -> None:
    """Send the off messages; set SPI mode and speed, as the kernel does not keep them. Raises OSError."""
    wire = os.open(device, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.ioctl(wire, WR_MODE, struct.pack("=B", 0))
        fcntl.ioctl(wire, WR_MAX_SPEED_HZ, struct.pack("=I", SPEED_HZ))
        for frame in off_frames(chip, leds):
            if os.write(wire, frame) != len(frame):
                raise OSError(f"{device} took a part of the frame only")
    finally:
        os.close(wire)


def blank_with_retries(device: str, leds: int, chip: str) -> None:
    """Send the off messages; if the bus fails, retry 200 times at intervals of 50 ms, then raise OSError."""
    for _ in range(TRIES):
        with suppress(OSError):
            blank(device, leds, chip)
            return
        select.select([], [], [], AGAIN_S)
    blank(device, leds, chip)


def prioritise() -> None:
    """Run before every ordinary process and keep all pages in memory: a busy computer must not delay the dark.

    Each of them only as far as it is permitted: without real-time priority the least nice value, else as before.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, MIN_NICE)
    with suppress(ImportError, OSError, MemoryError):  # a sandbox may forbid what ctypes needs
        import ctypes

        ctypes.CDLL(None).mlockall(MCL_CURRENT)  # without permission -1, and nothing is locked


def watch_threads(poller: select.poll, threads: list[str]) -> set[int]:
    """Register the ends of threads and return their descriptors; none before Linux 6.9."""
    ears = set()
    with suppress(OSError):
        for thread in threads:
            ears.add(os.pidfd_open(int(thread), PIDFD_THREAD))
    for ear in ears:
        poller.register(ear, select.POLLIN)
    return ears


def guard(device: str, leds: int, chip: str) -> None:
    """Turn the LEDs off when a lease expires; also when standard input or the parent process ends, and then return.

    The parent is watched too, because a forked process may hold its pipe open. After a lease has expired, the off frame
    is repeated every 50 ms until the next message: the parent may have been stopped between its lease and its light.
    It is also repeated after the end of a watched thread, which ends before the process: other threads of the parent
    may still be writing.
    """
    prioritise()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the guard must not end before its parent
    poller = select.poll()
    poller.register(0, select.POLLIN)
    poller.register(os.pidfd_open(os.getppid()), select.POLLIN)
    threads: set[int] = set()
    lease_ms: float | None = None  # poll() counts it from the last message
    with suppress(BrokenPipeError):  # the parent ended before it read the answer
        while True:
            heard = {ear for ear, _ in poller.poll(lease_ms)}
            for ear in heard & threads:
                poller.unregister(ear)
            if not heard or heard & threads:
                with suppress(OSError):
                    blank(device, leds, chip)
                lease_ms = 1000 * AGAIN_S
                continue
            message = os.read(0, 4096).decode("ascii") if heard == {0} else ""
            if not message:
                break
            word, *values = message.split("\n")[-2].split()
            lease_ms = 1000 * float(values[0]) if word == "lit" else None
            if word == "watch":
                threads = watch_threads(poller, values)
            os.write(1, b"old\n" if word == "watch" and not threads else b"ok\n")
    (blank if lease_ms is None else blank_with_retries)(device, leds, chip)


def main() -> int:
    """Run `blank`, `guard` with --guard, or `blank_with_retries` with --insist; return 1 after an OSError, else 0."""
    parser = argparse.ArgumentParser(description="Darken the ring of LEDs.")
    parser.add_argument("--device", required=True, help="the SPI device, such as /dev/spidev0.0")
    parser.add_argument("--leds", type=int, default=LEDS, help="how many APA102 LEDs the chain has")
    parser.add_argument("--chip", choices=("apa102", "tlc5971", "any"), default="any", help="what the chain is made of")
    parser.add_argument("--guard", action="store_true", help="darken when the parent ends or a lease runs out")
    parser.add_argument("--insist", action="store_true", help="try again for 10 s if the bus fails")
    arguments = parser.parse_args()
    try:
        darken = guard if arguments.guard else blank_with_retries if arguments.insist else blank
        darken(arguments.device, arguments.leds, arguments.chip)
    except OSError as error:
        sys.stderr.write(f"{arguments.device} cannot be darkened: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
