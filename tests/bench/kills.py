"""`make bench-kills`: the owner of the ring ends 200 times in five ways; how long did the LEDs shine after it?"""

import sys
from collections.abc import Sequence
from statistics import median

from tests.ports.emulators.bus.client import the_bus
from tests.ports.emulators.kills import LINGERING, WAYS, Death, death
from tests.ports.emulators.victim import LEASE_S, STEPS

KILLS = 200


def row(name: str, deaths: Sequence[Death]) -> None:
    """One line: in time of all, how many were lit at the end, median of those, worst."""
    lit_ms = [1000 * died.shone_s for died in deaths if died.shone_s > 0]
    in_time = sum(died.shone_s <= died.allowed_s for died in deaths)
    figures = f"{median(lit_ms):>6.1f} | {max(lit_ms):>6.1f}" if lit_ms else f"{'-':>6} | {'-':>6}"
    allowed = f"{1000 * max(died.allowed_s for died in deaths):>8.0f}"
    print(f"| {name:<22} | {in_time:>3} of {len(deaths):<3} | {len(lit_ms):>3} | {figures} | {allowed} |", flush=True)


def main(kills: int = KILLS) -> int:
    """Print the table; 1 if an eye was lit for too long."""
    deaths = [death(the_bus(), WAYS[number % len(WAYS)], number) for number in range(kills)]
    print(f"{kills} ends of the ring's owner, emulated bus, lease {1000 * LEASE_S:.0f} ms; ms of light after the end,")
    print(f"or of the last light in all where the owner lingers ({', '.join(LINGERING)})\n")
    print("| end | dark in time | lit | median, ms | worst, ms | allowed, ms |\n|---|---|---|---|---|---|")
    for way in WAYS:
        row(way, [died for died in deaths if died.way == way])
    for step in STEPS.values():
        of_step = [died for died in deaths if died.step == step and died.way not in LINGERING]
        if of_step:
            row(f"died while {step}", of_step)
    late = [died for died in deaths if died.shone_s > died.allowed_s]
    print(f"\ntoo late: {late or 'none'}")
    return int(bool(late))


if __name__ == "__main__":
    sys.exit(main())
