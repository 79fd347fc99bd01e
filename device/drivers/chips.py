"""Drivers of the I2C chips, through smbus2: TMP117 (thermometer), MAX17048 (fuel gauge), 24LC32 (head EEPROM)."""

import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any, TypeVar

from device.clock import Clock
from device.config.device_nodes import I2C
from device.errors import BusFault, MemoryDamaged
from device.values import BatteryState, HeadIdentity

TMP117_PER_C = 128
MAX17048_VOLTS = 78.125e-6
MAX17048_SHARE = 1 / 25600
PAGE = 32  # a 24LC32 takes 32 bytes at a time and needs 5 ms to store them
WRITING_S = 0.005
MAGIC = b"DSC1"
Read = TypeVar("Read")


class I2cBus:
    """I2C bus, opened through smbus2; an error of the bus is raised as a BusFault that names the chip or the bus.

    Several threads may read: a lock is held over each word, as the chip's address is a state of the opened device.
    """

    def __init__(self, device: str) -> None:
        try:
            from smbus2 import SMBus, i2c_msg
        except Exception as error:  # of another numpy's compiled part: ValueError
            raise BusFault(
                f"smbus2 cannot be used: {error}", "Install it: sudo apt install python3-smbus2, then make pi."
            ) from error
        self._message = i2c_msg
        self._address_lock = Lock()
        try:
            self._bus: Any = SMBus(device)
        except OSError as error:
            raise BusFault(f"{device} cannot be opened: {error}", I2C.remedy(device, error.errno)) from error

    def read_word(self, address: int, register: int) -> int:
        """Return the value of a 16-bit register, which the chip transmits high byte first."""
        with self._address_lock, _bus_faults(f"chip {address:#04x}"):
            low_first = int(self._bus.read_word_data(address, register))
        return (low_first & 0xFF) << 8 | low_first >> 8

    def write(self, address: int, data: bytes) -> None:
        """Write bytes to the chip at an I2C address."""
        with _bus_faults(f"chip {address:#04x}"):
            self._bus.i2c_rdwr(self._message.write(address, data))

    def read(self, address: int, address_in_chip: int, count: int) -> bytes:
        """Return `count` bytes of the memory chip at I2C address `address`, from `address_in_chip` on."""
        read = self._message.read(address, count)
        with _bus_faults(f"chip {address:#04x}"):
            self._bus.i2c_rdwr(self._message.write(address, address_in_chip.to_bytes(2, "big")), read)
        return bytes(read)

    def close(self) -> None:
        """Close the bus; closing twice is harmless."""
        self._bus.close()


class Tmp117:
    """TMP117 driver that implements `ports.Thermometer`."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self._bus, self._address = bus, address

    def read_c(self) -> float:
        """Return the temperature, degrees Celsius; BusFault without an answer or outside -40 to 125."""
        raw = self._bus.read_word(self._address, 0)
        signed = raw - (raw >> 15 << 16)
        return _plausible("thermometer", signed / TMP117_PER_C, lambda celsius: -40 <= celsius <= 125)


class Max17048:
    """MAX17048 driver that implements `ports.Battery`."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self._bus, self._address = bus, address

    def read(self) -> BatteryState:
        """Return charge (fraction, at most 1) and voltage, V; BusFault without an answer or outside 2 to 5 V."""
        volts = self._bus.read_word(self._address, 2) * MAX17048_VOLTS
        fraction = min(1.0, self._bus.read_word(self._address, 4) * MAX17048_SHARE)
        return _plausible("fuel gauge", BatteryState(fraction, volts), lambda charge: 2 <= charge.volts <= 5)


class Eeprom24:
    """24LC32 driver that implements `ports.HeadMemory`: magic number, length of the JSON text, JSON text, CRC-32."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock) -> None:
        self._bus, self._address, self._clock = bus, address, clock

    def read(self) -> HeadIdentity | None:
        """Return the stored identity; None if blank. MemoryDamaged if magic number or checksum is wrong; BusFault."""
        head = self._bus.read(self._address, 0, len(MAGIC) + 2)
        if head == b"\xff" * len(head):
            return None
        if not head.startswith(MAGIC):
            raise MemoryDamaged("the head's memory holds something else than an identity")
        size = int.from_bytes(head[len(MAGIC) :], "big")
        body = self._bus.read(self._address, len(head), min(size, 1024) + 4)
        text = body[:-4]
        sum_ = body[-4:]
        if zlib.crc32(text) != int.from_bytes(sum_, "big"):
            raise MemoryDamaged("the head's memory is damaged: its checksum does not fit")
        return HeadIdentity(**json.loads(text))

    def write(self, identity: HeadIdentity) -> None:
        """Write an identity page by page and verify it by reading it back; BusFault if it differs."""
        text = json.dumps({"serial": identity.serial, "calibration_id": identity.calibration_id}).encode()
        whole = MAGIC + len(text).to_bytes(2, "big") + text + zlib.crc32(text).to_bytes(4, "big")
        for place in range(0, len(whole), PAGE):
            self._bus.write(self._address, place.to_bytes(2, "big") + whole[place : place + PAGE])
            self._clock.sleep(WRITING_S)
        if self.read() != identity:
            raise BusFault("the head's memory does not hold what was written")


@contextmanager
def _bus_faults(what: str) -> Iterator[None]:
    """Raise a BusFault that names the part `what` in place of an OSError of the block."""
    try:
        yield
    except OSError as error:
        raise BusFault(f"{what} does not answer: {error}") from error


def _plausible(what: str, value: Read, sound: Callable[[Read], bool]) -> Read:
    """Return the value if `sound` accepts it; else raise a BusFault that names the part `what`."""
    if not sound(value):
        raise BusFault(f"the {what} says {value}, which cannot be")
    return value
