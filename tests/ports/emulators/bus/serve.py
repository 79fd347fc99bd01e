"""Emulated SPI and I2C buses behind umockdev, in a process of its own: `/usr/bin/python3 serve.py FOLDER`.

Prints the root that UMOCKDEV_DIR must name. Each SPI message is logged in FOLDER/spi.jsonl with its time
(CLOCK_MONOTONIC, seconds), its bytes and the LEDs that are lit after it; those of the second bus, with a TLC5971, in
FOLDER/sinks.jsonl, with the outputs that are lit; each I2C message in FOLDER/i2c.jsonl with its
chip, direction and bytes. FOLDER/faults lists the active faults, one word to a line: "spi.short" (half a message
arrives), "spi.cut" (the bus answers EIO), "i2c.silent" (no chip answers), "led.N" (LED N is dead), "power" (brown-out:
the chain loses its latch and takes nothing), "spi.latchup" (the chain keeps what it shows), "memory.blank" (the EEPROM
is as delivered).
"""

import json
import os
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path

import gi

gi.require_version("UMockdev", "1.0")
from chain import Chain, Sinks  # noqa: E402
from chips import Eeprom, Words  # noqa: E402
from gi.repository import GLib, UMockdev  # noqa: E402

FOLDER = Path(sys.argv[1])
with suppress(OSError):  # a bus is hardware: it waits for no process, where that is permitted
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
EIO, ENXIO, EINVAL, ENOTTY = 5, 6, 22, 25
DEVICES = """P: /devices/platform/soc/spi0.0/spidev/spidev0.0
N: spidev0.0
E: DEVNAME=/dev/spidev0.0
E: SUBSYSTEM=spidev

P: /devices/platform/soc/spi1.0/spidev/spidev1.0
N: spidev1.0
E: DEVNAME=/dev/spidev1.0
E: SUBSYSTEM=spidev

P: /devices/platform/soc/i2c-1/i2c-dev/i2c-1
N: i2c-1
E: DEVNAME=/dev/i2c-1
E: SUBSYSTEM=i2c-dev
"""


def faults():
    path = FOLDER / "faults"
    return set(path.read_text(encoding="ascii").split()) if path.exists() else set()


class Bus(UMockdev.IoctlBase):
    """Bus that answers every request: an unanswered ioctl would block the caller for ever."""

    def do_handle_ioctl(self, client):
        try:
            result, errno = self.answer(client.get_request() & 0xFFFFFFFF, client.get_arg())
        except (ValueError, struct.error, OverflowError):
            result, errno = -1, EINVAL
        client.complete(result, errno)
        return True


class Spi(Bus):
    """SPI controller with its settings and the connected chain."""

    def __init__(self, power_up, log):
        super().__init__()
        self.power_up = power_up
        self.settings = {
            1: 0,
            2: 0,
            3: 8,
            4: 125_000_000,
            5: 0,
        }  # mode, bit order, bits, hertz as in a Pi's device tree, mode32
        self.chain = power_up()
        self.log = (FOLDER / log).open("a", encoding="ascii")

    def answer(self, request, arg):
        size, number = (request >> 16) & 0x3FFF, request & 0xFF
        if (request >> 8) & 0xFF != ord("k"):
            return -1, ENOTTY
        if number == 0:
            return self.transfer(arg, size)
        data = arg.resolve(0, size)
        if request >> 30 == 2:
            data.update(0, list(self.settings[number].to_bytes(4, "little")[:size]))
        else:
            self.settings[number] = int.from_bytes(bytes(data.retrieve()), "little")
        return 0, 0

    def transfer(self, arg, size):
        messages = arg.resolve(0, size)
        raw, total = bytes(messages.retrieve()), 0
        for at in range(0, size, 32):
            tx, rx, length = struct.unpack_from("<QQI", raw, at)
            sent = bytes(messages.resolve(at, length).retrieve()) if tx else bytes(length)
            if self.take(sent) < 0:
                return -1, EIO
            if rx:
                messages.resolve(at + 8, length).update(0, list(bytes(length)))
            total += length
        return total, 0

    def do_handle_write(self, client):
        arg = client.get_arg()
        taken = self.take(bytes(arg.retrieve()) if arg else b"")
        client.complete(taken, EIO if taken < 0 else 0)
        return True

    def take(self, wire):
        active_faults = faults()
        if "spi.cut" in active_faults:
            return -1
        if "power" in active_faults:
            self.chain = self.power_up()
            return self.logged(wire)
        self.chain.dead = {int(name[4:]) for name in active_faults if name.startswith("led.")}
        arrived = wire[: len(wire) // 2] if "spi.short" in active_faults else wire
        if "spi.latchup" not in active_faults:
            self.chain.take(arrived)
        return self.logged(arrived)

    def logged(self, arrived):
        seen = {"at_s": time.monotonic(), "hz": self.settings[4], "bytes": len(arrived), "lit": self.chain.lit}
        self.log.write(json.dumps(seen | {"mode": self.settings[1], "hex": arrived.hex()}) + "\n")
        self.log.flush()
        return len(arrived)


class I2c(Bus):
    """I2C adapter with plain messages and the word reads of SMBus."""

    def __init__(self, chips):
        super().__init__()
        self.chips, self.address = chips, 0
        self.log = (FOLDER / "i2c.jsonl").open("a", encoding="ascii")

    def note(self, address, way, data):
        self.log.write(json.dumps({"chip": address, way: bytes(data).hex()}) + "\n")
        self.log.flush()
        return bytes(data)

    def answer(self, request, arg):
        if request == 0x0705:  # I2C_FUNCS
            arg.resolve(0, 8).update(0, list(struct.pack("<Q", 0x0EFF0009)))
            return 0, 0
        if request == 0x0703:  # I2C_SLAVE
            self.address = int.from_bytes(bytes(arg.retrieve())[:8], "little")
            return 0, 0
        if request == 0x0707:
            return self.messages(arg)
        if request == 0x0720:
            return self.smbus(arg)
        return -1, ENOTTY

    def chip(self, address):
        active_faults = faults()
        if "memory.blank" in active_faults:
            self.chips[0x50] = Eeprom()
        return None if "i2c.silent" in active_faults else self.chips.get(address)

    def messages(self, arg):
        head = arg.resolve(0, 16)
        _, count = struct.unpack("<QI", bytes(head.retrieve())[:12])
        table = head.resolve(0, count * 16)
        raw = bytes(table.retrieve())
        for at in range(0, 16 * count, 16):
            address, flags, length = struct.unpack_from("<HHH", raw, at)
            chip = self.chip(address)
            if chip is None:
                return -1, ENXIO
            buffer = table.resolve(at + 8, length)
            if flags & 1:
                buffer.update(0, list(self.note(address, "read", chip.read(length))))
            else:
                chip.write(self.note(address, "write", buffer.retrieve()))
        return count, 0

    def smbus(self, arg):
        data = arg.resolve(0, 16)
        reads, command, size, _ = struct.unpack("<BBxxIQ", bytes(data.retrieve()))
        chip = self.chip(self.address)
        if chip is None:
            return -1, ENXIO
        if size == 3:  # a word, the low byte first
            block = data.resolve(8, 34)
            written = bytes([command]) + (b"" if reads else bytes(block.retrieve())[:2])
            chip.write(self.note(self.address, "write", written))
            if reads:
                block.update(0, list(self.note(self.address, "read", chip.read(2))))
            return 0, 0
        return (0, 0) if size == 0 else (-1, EINVAL)


testbed = UMockdev.Testbed.new()
testbed.add_from_string(DEVICES)
testbed.attach_ioctl("/dev/spidev0.0", Spi(Chain, "spi.jsonl"))
testbed.attach_ioctl("/dev/spidev1.0", Spi(Sinks, "sinks.jsonl"))
# 25.0 C; 77.5 % and 3.88 V; a blank EEPROM of 4096 bytes
chips = {0x48: Words({0: 0x0C80, 15: 0x0117}), 0x36: Words({2: 0xC200, 4: 0x4D80}), 0x50: Eeprom()}
testbed.attach_ioctl("/dev/i2c-1", I2c(chips))
print(testbed.get_root_dir(), flush=True)
loop = GLib.MainLoop()
GLib.io_add_watch(0, GLib.IO_HUP, loop.quit)  # of standard input: this process ends with the one that started it
loop.run()
