"""The chips on the I2C bus, as registers and memory: what their data sheets promise, and no more."""


class Registers:
    """Big-endian 16-bit registers behind a pointer: TMP117 and MAX17048."""

    def __init__(self, values: dict[int, int]) -> None:
        self.values, self._at = values, 0

    def write(self, data: bytes) -> None:
        if data:
            self._at = data[0]
        if len(data) == 3:
            self.values[self._at] = int.from_bytes(data[1:], "big")

    def read(self, length: int) -> bytes:
        return self.values.get(self._at, 0).to_bytes(2, "big")[:length]


class Eeprom:
    """A 24LC32: 4096 bytes, 16-bit addresses, pages of 32 bytes in which a write wraps."""

    PAGE = 32

    def __init__(self) -> None:
        self.cells, self._at = bytearray(b"\xff" * 4096), 0

    def write(self, data: bytes) -> None:
        if len(data) < 2:
            return
        self._at = int.from_bytes(data[:2], "big") % len(self.cells)
        page = self._at - self._at % self.PAGE
        for offset, value in enumerate(data[2:]):
            self.cells[page + (self._at - page + offset) % self.PAGE] = value

    def read(self, length: int) -> bytes:
        data = bytes(self.cells[(self._at + i) % len(self.cells)] for i in range(length))
        self._at = (self._at + length) % len(self.cells)
        return data


def celsius(degrees: float) -> int:
    """A TMP117's register 0: 1/128 of a degree, two's complement."""
    return round(degrees * 128) & 0xFFFF


def chips() -> dict[int, Registers | Eeprom]:
    """What answers at which address: 0x48 TMP117, 0x36 MAX17048, 0x50 24LC32."""
    thermometer = Registers({0x00: celsius(25), 0x0F: 0x0117})
    gauge = Registers({0x02: round(3.9 / 78.125e-6), 0x04: round(77.5 * 256)})
    return {0x48: thermometer, 0x36: gauge, 0x50: Eeprom()}
