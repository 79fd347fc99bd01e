"""The emulated buses: a process of its own, run by the system's Python (which has gi) for tests under umockdev-wrapper.

    /usr/bin/python3 tests/ports/emulators/bus FOLDER

says on standard output where UMOCKDEV_DIR must point, then obeys lines on standard input and answers each with "ok".
FOLDER/lit.log has a line for every SPI message: CLOCK_MONOTONIC in ns when it was done, how many LEDs shine since, Hz,
bytes of the message. FOLDER/leds.json, replaced whole, says which colour each LED shows.
"""

import json
import struct
import sys
import time
from pathlib import Path

import gi

gi.require_version("UMockdev", "1.0")
from chain import Chain  # noqa: E402
from chips import celsius, chips  # noqa: E402
from gi.repository import GLib, UMockdev  # noqa: E402

SPI, I2C = "/dev/spidev0.0", "/dev/i2c-1"
DEVICES = """\
P: /devices/platform/soc/spi0.0/spidev/spidev0.0
N: spidev0.0
E: DEVNAME=/dev/spidev0.0
E: SUBSYSTEM=spidev

P: /devices/platform/soc/i2c-1/i2c-dev/i2c-1
N: i2c-1
E: DEVNAME=/dev/i2c-1
E: SUBSYSTEM=i2c-dev
"""
TRANSFER = struct.Struct("=QQIIHBBBBBB")  # struct spi_ioc_transfer
ENXIO, EIO, EINVAL, ENOTTY, EOPNOTSUPP = 6, 5, 22, 25, 95


class Faults:
    """What is broken now: spi.error, spi.short, i2c.nack (every address) or i2c.nack.48."""

    def __init__(self) -> None:
        self.now: set[str] = set()

    def nack(self, address: int) -> bool:
        return "i2c.nack" in self.now or f"i2c.nack.{address:x}" in self.now


class Answering(UMockdev.IoctlBase):
    """Completes every request, also one that we do not know: a request without an answer hangs its caller."""

    def do_handle_ioctl(self, client):
        try:
            done, errno = self.ioctl(client.get_request() & 0xFFFFFFFF, client.get_arg())
        except (ValueError, IndexError, KeyError, struct.error, TypeError, GLib.Error) as error:
            sys.stderr.write(f"emulator: {error!r}\n")
            done, errno = -1, EINVAL
        client.complete(done, errno)
        return True

    def do_handle_read(self, client):
        client.complete(-1, EOPNOTSUPP)
        return True


class Spi(Answering):
    """spidev's ioctls and write(2), on a chain of LEDs."""

    def __init__(self, chain, faults, folder):
        super().__init__()
        self.chain, self.faults, self.folder = chain, faults, Path(folder)
        self.mode, self.bits, self.hz = 0, 8, 125_000_000
        self.log = (self.folder / "lit.log").open("a", buffering=1)
        self.show()

    def show(self):
        whole = self.folder / "leds.json"
        part = whole.with_suffix(".part")
        part.write_text(json.dumps({"rgb": self.chain.rgb, "hz": self.hz, "at_ns": time.monotonic_ns()}))
        part.replace(whole)

    def message(self, data, hz):
        """One message on the wire; the number of bytes that got through, or a negative errno."""
        if "spi.error" in self.faults.now:
            return -EIO
        sent = data[: len(data) // 2] if "spi.short" in self.faults.now else data
        before = self.chain.rgb.copy()
        self.chain.take(sent)
        self.log.write(f"{time.monotonic_ns()} {self.chain.lit} {hz} {len(sent)}\n")
        if self.chain.rgb != before:
            self.show()
        return len(sent)

    def do_handle_write(self, client):
        done = self.message(bytes(client.get_arg().retrieve()), self.hz)
        client.complete(max(done, -1), -done if done < 0 else 0)
        return True

    def ioctl(self, request, arg):
        size, kind, number = (request >> 16) & 0x3FFF, chr((request >> 8) & 0xFF), request & 0xFF
        if kind != "k":
            return -1, ENOTTY
        data = arg.resolve(0, size)
        if number == 0:
            return self.transfers(data, size)
        name = {1: "mode", 2: None, 3: "bits", 4: "hz", 5: "mode"}[number]
        if request >> 30 == 2:  # read by the caller
            data.update(0, list((getattr(self, name) if name else 0).to_bytes(size, "little")))
        elif name:
            setattr(self, name, int.from_bytes(bytes(data.retrieve()), "little"))
        return 0, 0

    def transfers(self, data, size):
        raw, total = bytes(data.retrieve()), 0
        for at in range(0, size, TRANSFER.size):
            tx, _, length, hz, *_ = TRANSFER.unpack_from(raw, at)
            sent = bytes(data.resolve(at, length).retrieve()) if tx else bytes(length)
            if (done := self.message(sent, hz or self.hz)) < 0:
                return -1, -done
            total += length
        return total, 0


class I2c(Answering):
    """i2c-dev's ioctls: plain messages, SMBus byte and word data, and quick."""

    def __init__(self, parts, faults):
        super().__init__()
        self.parts, self.faults, self.address = parts, faults, 0

    def part(self, address):
        return None if self.faults.nack(address) else self.parts.get(address)

    def ioctl(self, request, arg):
        if request == 0x0705:  # I2C_FUNCS
            arg.resolve(0, 8).update(0, list(struct.pack("=Q", 0x0EFF0009)))
            return 0, 0
        if request in (0x0703, 0x0706):  # I2C_SLAVE, and by force
            self.address = int.from_bytes(bytes(arg.retrieve())[:8], "little")
            return 0, 0
        if request == 0x0707:
            return self.messages(arg)
        return self.smbus(arg) if request == 0x0720 else (-1, ENOTTY)

    def messages(self, arg):
        head = arg.resolve(0, 16)
        (count,) = struct.unpack_from("=I", bytes(head.retrieve()), 8)
        messages = head.resolve(0, 16 * count)
        raw = bytes(messages.retrieve())
        for at in range(0, 16 * count, 16):
            address, flags, length = struct.unpack_from("=HHH", raw, at)
            if (part := self.part(address)) is None:
                return -1, ENXIO
            buffer = messages.resolve(at + 8, length)
            if flags & 1:
                buffer.update(0, list(part.read(length)))
            else:
                part.write(bytes(buffer.retrieve()))
        return count, 0

    def smbus(self, arg):
        head = arg.resolve(0, 16)
        reading, command, kind = struct.unpack_from("=BBxxI", bytes(head.retrieve()))
        if (part := self.part(self.address)) is None:
            return -1, ENXIO
        length = {0: 0, 2: 1, 3: 2}[kind]  # quick, byte data, word data
        if kind == 0:
            return 0, 0
        union = head.resolve(8, 34)
        if reading:
            part.write(bytes([command]))
            union.update(0, list(part.read(length)))
        else:
            part.write(bytes([command]) + bytes(union.retrieve())[:length])
        return 0, 0


class Emulator:
    """The chain, the chips, and the words that change them."""

    def __init__(self, folder):
        self.faults, self.chain, self.parts = Faults(), Chain(), chips()
        self.spi, self.i2c = Spi(self.chain, self.faults, folder), I2c(self.parts, self.faults)

    def obey(self, line):
        """fault NAME | mend NAME | dead LED | brownout | celsius C | gauge FRACTION VOLTS | forget"""
        word, *rest = line.split()
        if word == "fault":
            self.faults.now.add(rest[0])
        elif word == "mend":
            self.faults.now.clear() if not rest else self.faults.now.discard(rest[0])
            if not rest:
                self.chain.dead.clear()
        elif word == "dead":
            self.chain.dead.add(int(rest[0]))
        elif word == "brownout":
            self.chain.power_lost()
            self.parts[0x36].values[0x02] = round(2.9 / 78.125e-6)
            self.spi.show()
        elif word == "celsius":
            self.parts[0x48].values[0] = celsius(float(rest[0]))
        elif word == "gauge":
            self.parts[0x36].values.update({4: round(float(rest[0]) * 25600), 2: round(float(rest[1]) / 78.125e-6)})
        elif word == "forget":
            self.parts[0x50].cells[:] = b"\xff" * 4096
        else:
            raise ValueError(f"what is {word!r}?")


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main():
    emulator = Emulator(sys.argv[1])
    testbed = UMockdev.Testbed.new()
    testbed.add_from_string(DEVICES)
    testbed.attach_ioctl(SPI, emulator.spi)
    testbed.attach_ioctl(I2C, emulator.i2c)
    loop = GLib.MainLoop()

    def hear(channel, condition):
        line = sys.stdin.readline()
        if not line:
            loop.quit()
            return False
        emulator.obey(line)
        say("ok")
        return True

    GLib.io_add_watch(sys.stdin.fileno(), GLib.IO_IN | GLib.IO_HUP, hear)
    say(testbed.get_root_dir())
    loop.run()


main()
