"""An APA102 chain as its wire sees it: bytes in, colours out; each colour stays until another comes (the latch)."""


class Chain:
    """`rgb` is what each LED shows. Borders of messages mean nothing: it waits for 32 zero bits, then takes frames."""

    def __init__(self, leds: int = 64) -> None:
        self.rgb: list[tuple[int, int, int]] = [(0, 0, 0)] * leds
        self.dead: set[int] = set()
        self._zeros = self._next = 0
        self._listening = False
        self._part = b""

    @property
    def lit(self) -> int:
        """How many LEDs shine."""
        return sum(any(rgb) for rgb in self.rgb)

    def power_lost(self) -> None:
        """A brown-out: what was latched is forgotten."""
        self.rgb = [(0, 0, 0)] * len(self.rgb)
        self._listening, self._part, self._zeros = False, b"", 0

    def take(self, data: bytes) -> None:
        """Shift bytes in."""
        for byte in data:
            if self._listening:
                self._word(byte)
            else:
                self._wait(byte)

    def _wait(self, byte: int) -> None:
        if byte == 0:
            self._zeros += 1
        elif self._zeros >= 4 and byte >= 0xE0:
            self._listening, self._next, self._part = True, 0, bytes([byte])
        else:
            self._zeros = 0

    def _word(self, byte: int) -> None:
        if not self._part and byte < 0xE0:  # not an LED's frame: the tail, or the next start
            self._listening, self._zeros = False, 1 if byte == 0 else 0
            return
        self._part += bytes([byte])
        if len(self._part) == 4:
            brightness, blue, green, red = self._part
            if self._next < len(self.rgb):
                dark = self._next in self.dead or brightness == 0xE0
                self.rgb[self._next] = (0, 0, 0) if dark else (red, green, blue)
            self._next, self._part = self._next + 1, b""
