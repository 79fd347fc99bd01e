"""Emulated chain of APA102 LEDs: received data are latched for as long as there is power."""

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
