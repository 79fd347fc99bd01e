"""The chips on the I2C bus, through smbus2: TMP117 (thermometer), MAX17048 (fuel gauge), 24LC32 (the head's memory)."""

import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from device.clock import Clock
from device.errors import BusFault, MemoryDamaged
from device.values import Charge, Identity

TMP117_PER_C = 128
MAX17048_VOLTS, MAX17048_SHARE = 78.125e-6, 1 / 25600
PAGE, WRITING_S = 32, 0.005  # a 24LC32 takes 32 bytes at a time, and 5 ms to keep them
MAGIC = b"DSC1"
Read = TypeVar("Read")


class I2cBus:
    """One bus, opened through smbus2; what goes wrong on it is a BusFault that names the chip."""

    def __init__(self, device: str) -> None:
        try:
            from smbus2 import SMBus, i2c_msg
        except ImportError as error:
            raise BusFault(f"smbus2 cannot be used: {error}", "Install python3-smbus2.") from error
        self._message = i2c_msg
        with _told(device):
            self._bus: Any = SMBus(device)

    def word(self, address: int, register: int) -> int:
        """A register of 16 bits, high byte first."""
        with _told(f"chip {address:#04x}"):
            low_first = int(self._bus.read_word_data(address, register))
        return (low_first & 0xFF) << 8 | low_first >> 8

    def send(self, address: int, data: bytes) -> None:
        """Write bytes."""
        with _told(f"chip {address:#04x}"):
            self._bus.i2c_rdwr(self._message.write(address, data))

    def fetch(self, address: int, place: int, count: int) -> bytes:
        """Read bytes from a 16-bit place on."""
        read = self._message.read(address, count)
        with _told(f"chip {address:#04x}"):
            self._bus.i2c_rdwr(self._message.write(address, place.to_bytes(2, "big")), read)
        return bytes(read)

    def close(self) -> None:
        """Let the bus go; closing twice is harmless."""
        self._bus.close()


class Tmp117:
    """A Thermometer."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self._bus, self._address = bus, address

    def read_c(self) -> float:
        """Degrees Celsius now."""
        raw = self._bus.word(self._address, 0)
        signed = raw - (raw >> 15 << 16)
        return _believed("thermometer", signed / TMP117_PER_C, lambda celsius: -40 <= celsius <= 125)


class Max17048:
    """A Battery."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self._bus, self._address = bus, address

    def read(self) -> Charge:
        """How full it is."""
        volts = self._bus.word(self._address, 2) * MAX17048_VOLTS
        fraction = min(1.0, self._bus.word(self._address, 4) * MAX17048_SHARE)
        return _believed("fuel gauge", Charge(fraction, volts), lambda charge: 2 <= charge.volts <= 5)


class Eeprom24:
    """A HeadMemory: a mark, a length, plain JSON and a checksum."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock) -> None:
        self._bus, self._address, self._clock = bus, address, clock

    def read(self) -> Identity | None:
        """What it holds; None if nothing was ever written."""
        head = self._bus.fetch(self._address, 0, len(MAGIC) + 2)
        if head == b"\xff" * len(head):
            return None
        if not head.startswith(MAGIC):
            raise MemoryDamaged("the head's memory holds something else than an identity")
        size = int.from_bytes(head[len(MAGIC) :], "big")
        body = self._bus.fetch(self._address, len(head), min(size, 1024) + 4)
        text, sum_ = body[:-4], body[-4:]
        if zlib.crc32(text) != int.from_bytes(sum_, "big"):
            raise MemoryDamaged("the head's memory is damaged: its checksum does not fit")
        return Identity(**json.loads(text))

    def write(self, identity: Identity) -> None:
        """Keep this from now on, page by page, and read it back."""
        text = json.dumps({"serial": identity.serial, "calibration_id": identity.calibration_id}).encode()
        whole = MAGIC + len(text).to_bytes(2, "big") + text + zlib.crc32(text).to_bytes(4, "big")
        for place in range(0, len(whole), PAGE):
            self._bus.send(self._address, place.to_bytes(2, "big") + whole[place : place + PAGE])
            self._clock.sleep(WRITING_S)
        if self.read() != identity:
            raise BusFault("the head's memory does not hold what was written")


@contextmanager
def _told(what: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BusFault(f"{what} does not answer: {error}") from error


def _believed(what: str, value: Read, sound: Callable[[Read], bool]) -> Read:
    if not sound(value):
        raise BusFault(f"the {what} says {value}, which cannot be")
    return value
