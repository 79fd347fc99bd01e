"""Plain words for the messages on the emulated buses, with their bytes."""

import sys
from itertools import groupby
from pathlib import Path
from threading import Event, Thread

from tests.ports.emulators.wires import COLOURS, FULL, LogTail

POLL_S = 0.1


class SpiWords:
    """Words for the messages to the ring: each in full where it differs from the last ones, else counted."""

    def __init__(self) -> None:
        self._cycle: set[str] = set()  # what is sent again and again: a lit message and the dark one after it
        self._repeats = 0

    def __call__(self, message: dict) -> list[str]:
        if message["hex"] in self._cycle:
            self._repeats += 1
            return []
        lines = []
        if message["lit"] or not self._cycle:
            lines, self._cycle = self.rest(), set()
        self._cycle.add(message["hex"])
        lines.append(f"SPI  {message['bytes']} bytes at {message['hz'] / 1e6:g} MHz: {ring_words(message['lit'])}")
        lines.append(f"     {grouped(message['hex'])}")
        return lines

    def rest(self) -> list[str]:
        """Return how often the last messages were repeated, and set the count to zero."""
        repeats, self._repeats = self._repeats, 0
        return [f"SPI  {repeats} more messages of the same bytes"] if repeats else []


def grouped(digits: str) -> str:
    """Return hexadecimal bytes as words of four, equal neighbours counted: `00000000, 64 x ff000000`."""
    words = [digits[at : at + 8] for at in range(0, len(digits), 8)]
    runs = [(word, len([*equal])) for word, equal in groupby(words)]
    return ", ".join(word if count == 1 else f"{count} x {word}" for word, count in runs)


def ring_words(lit: dict[str, list[int]]) -> str:
    """Return which LEDs of the ring are lit, their colour and level."""
    if not lit:
        return "the ring is dark"
    levels = [max(colours) for colours in lit.values()]
    colour = COLOURS[max(range(3), key=lambda channel: sum(colours[channel] for colours in lit.values()))]
    return f"LEDs {' '.join(lit)} {colour}, at {max(levels) / FULL:.0%}"


class I2cWords:
    """Words for the readings of the chips, where they differ from the last ones."""

    def __init__(self) -> None:
        self._register = ""
        self._last: dict[tuple[int, str], str] = {}

    def __call__(self, message: dict) -> list[str]:
        if "write" in message:
            self._register = message["write"]
            return []
        chip, answer = message["chip"], message["read"]
        place = chip, self._register
        if self._last.get(place) == answer:
            return []
        self._last[place] = answer
        return [f"I2C  chip {chip:#04x} answers {answer}: {reading(*place, bytes.fromhex(answer))}"]


def reading(chip: int, register: str, answer: bytes) -> str:
    """Return the reading of a chip in words."""
    value = int.from_bytes(answer, "big", signed=True)
    return {
        (0x48, "00"): f"thermometer, {value / 128:.1f} C",
        (0x36, "02"): f"battery, {int.from_bytes(answer, 'big') * 78.125e-6:.2f} V",
        (0x36, "04"): f"battery, {int.from_bytes(answer, 'big') / 25600:.1%}",
    }.get((chip, register), f"memory of the head, {len(answer)} bytes")


class BusPrinter(Thread):
    """Thread that prints the messages of the buses in `folder` until it is stopped."""

    def __init__(self, folder: Path) -> None:
        super().__init__(name="bus printer", daemon=True)
        self._ended = Event()
        self._spi, self._i2c = LogTail(folder / "spi.jsonl"), LogTail(folder / "i2c.jsonl")
        self._spi_words, self._i2c_words = SpiWords(), I2cWords()

    def run(self) -> None:
        while not self._ended.wait(POLL_S):
            self._print()

    def stop(self) -> None:
        """Print what is left, and end the thread."""
        self._ended.set()
        self.join()
        self._print()
        write(self._spi_words.rest())

    def _print(self) -> None:
        write([line for message in self._i2c() for line in self._i2c_words(message)])
        write([line for message in self._spi() for line in self._spi_words(message)])


def write(lines: list[str]) -> None:
    """Print lines at once, whole."""
    if lines:
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
