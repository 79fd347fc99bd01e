"""Emulated chains of APA102 LEDs and of TLC5971 drivers: received data are latched as long as there is power."""

START = bytes(4)
FULL = 31


class Chain:
    """Chain of `count` LEDs; `dead` ones stay dark; a new Chain models a power cycle."""

    def __init__(self, count: int = 64) -> None:
        self.levels: list[tuple[int, int, int]] = [(0, 0, 0)] * count
        self.dead: set[int] = set()

    def take(self, wire: bytes) -> None:
        """Shift in a message: a frame reaches as many LEDs as it holds, and the others keep their levels."""
        begin = wire.find(START)
        if begin < 0:
            return
        words = wire[begin + len(START) :]
        for index in range(len(self.levels)):
            word = words[4 * index : 4 * index + 4]
            if len(word) < 4 or word[0] >> 5 != 0b111:
                return
            share, (blue, green, red) = (word[0] & FULL) / FULL, word[1:]
            shown = tuple(round(level * share) for level in (red, green, blue))
            self.levels[index] = (0, 0, 0) if index in self.dead else shown

    @property
    def lit(self) -> dict[int, tuple[int, int, int]]:
        """Return the lit LEDs with their red, green and blue levels."""
        return {index: levels for index, levels in enumerate(self.levels) if any(levels)}


PACKET, OUTPUTS, COMMAND, BLANK = 28, 12, 0x25, 1


class Sinks:
    """Chain of TLC5971 in the mode of the internal clock; dark after power-up, as BLANK is then set."""

    def __init__(self, chips: int = 1) -> None:
        self.register = bytes(PACKET * chips)
        self.latched = [(0x94 << 24 | 0x20 << 16).to_bytes(4, "big") + bytes(24)] * chips
        self.dead: set[int] = set()

    def take(self, wire: bytes) -> None:
        """Shift in a message; the pause of the clock after it latches every packet that begins with the command."""
        self.register = (self.register + wire)[-len(self.register) :]
        for chip in range(len(self.latched)):
            end = len(self.register) - PACKET * chip
            packet = self.register[end - PACKET : end]
            if packet[0] >> 2 == COMMAND:
                self.latched[chip] = packet

    @property
    def lit(self) -> dict[int, float]:
        """Return the outputs that sink current, 0 to 1 of the resistor's current."""
        found = {}
        for chip, packet in enumerate(self.latched):
            head = int.from_bytes(packet[:4], "big")
            if head >> 21 & BLANK:
                continue
            for output in range(OUTPUTS):
                at = PACKET - 2 * (output + 1)
                grey = int.from_bytes(packet[at : at + 2], "big") / 0xFFFF
                level = grey * (head >> 7 * (output % 3) & 0x7F) / 0x7F
                if level > 0 and OUTPUTS * chip + output not in self.dead:
                    found[OUTPUTS * chip + output] = round(level, 6)
        return found
