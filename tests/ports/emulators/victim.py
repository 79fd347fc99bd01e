"""A process that holds the ring as an exam does, until it is killed or stopped, raises or hangs: `victim.py MODE SEED`.

It says the step it is about to take on standard output, one letter each: see STEPS. MODE is "work" (on and on), or
"raise" or "hang" (after a random number of steps, lit or dark; "h" says that it hangs now).
"""

import os
import random
import sys
import time

from device.drivers.guardian import Guardian
from device.drivers.ring import Apa102Ring
from device.spec import LightSpec
from device.values import Glow

STEPS = {"d": "dark", "u": "lighting up", "r": "lit, red", "g": "lit, green", "o": "darkening"}
LEASE_S = 0.3


class Life:
    """The steps of an exam, at random paces, and the one in which it fails."""

    def __init__(self, mode: str, seed: int) -> None:
        self.mode, self.chance = mode, random.Random(seed)
        self.left = self.chance.randrange(2, 30)

    def step(self, letter: str, most_s: float = 0.0) -> None:
        """Say where we are, stay a while, and perhaps fail here."""
        os.write(1, letter.encode())
        time.sleep(self.chance.uniform(0, most_s))
        self.left -= 1
        if self.left <= 0 and self.mode == "raise":
            raise ZeroDivisionError("as any code above the light may")
        if self.left <= 0 and self.mode == "hang":
            os.write(1, b"h")
            while True:
                sum(range(10**6))


def main(mode: str, seed: int) -> None:
    spec = LightSpec(backend="apa102", max_on_s=LEASE_S)
    ring, life = Apa102Ring(spec, Guardian(spec.spi_device, spec.leds)), Life(mode, seed)
    while True:
        for letter, glow in (("r", Glow("red", 0.5)), ("g", Glow("green"))):
            life.step("d", 0.01)
            life.step("u")
            with ring.on(glow):
                life.step(letter, 0.03)
                life.step("o")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
