"""Emulated I2C chips: a register pointer with the registers or memory that it addresses."""


class Words:
    """Chip with 16-bit registers, high byte first: TMP117, MAX17048."""

    def __init__(self, registers: dict[int, int]) -> None:
        self.registers, self._at = dict(registers), 0

    def write(self, data: bytes) -> None:
        if data:
            self._at = data[0]
        if len(data) >= 3:
            self.registers[self._at] = data[1] << 8 | data[2]

    def read(self, count: int) -> bytes:
        return self.registers.get(self._at, 0).to_bytes(2, "big")[:count]


class Eeprom:
    """24LC32: 4096 bytes with a 16-bit address; a write wraps round inside a page of 32 bytes."""

    def __init__(self) -> None:
        self.bytes, self._at = bytearray(b"\xff" * 4096), 0

    def write(self, data: bytes) -> None:
        if len(data) >= 2:
            self._at = (data[0] << 8 | data[1]) & 0xFFF
        page = self._at & ~31
        for offset, value in enumerate(data[2:]):
            self.bytes[page + ((self._at - page + offset) & 31)] = value

    def read(self, count: int) -> bytes:
        found = bytes(self.bytes[(self._at + k) & 0xFFF] for k in range(count))
        self._at = (self._at + count) & 0xFFF
        return found
