"""`make bench-kills`: how long an eye still has light after the process that holds the lamp is killed, 200 times."""

import random
import signal

import numpy as np

from tests.bench import timing
from tests.ports.emulators.kills import Death, Victim
from tests.ports.emulators.wires import wires

KILLS, STOPS = 200, 20
LEASE_S, DARK_S = 0.4, 0.1
ENDS = {"hang": LEASE_S + DARK_S, "raise": DARK_S, "exit": DARK_S}


def main() -> None:
    """Kill at random moments of random phases, and print what it came to."""
    timing.head("dark after (emulated bus)", "times", "lit then", "median ms", "worst ms", "limit")
    draw = random.Random(1)
    for how, times, limit_s in ((signal.SIGKILL, KILLS, DARK_S), (signal.SIGSTOP, STOPS, LEASE_S + DARK_S)):
        told(how.name, [Victim(wires(), LEASE_S).die(how, draw.uniform(0, 0.5)) for _ in range(times)], limit_s)
    for end, limit_s in ENDS.items():
        told(f"{end}, with the lamp on", [Victim(wires(), LEASE_S, end).end(end) for _ in range(5)], limit_s)


def told(name: str, deaths: list[Death], limit_s: float) -> None:
    """One line: those that died with the lamp on count for the median."""
    lit = [death.dark_after_s * 1e3 for death in deaths if death.was_lit]
    worst = max(death.dark_after_s * 1e3 for death in deaths)
    middle = float(np.median(lit)) if lit else 0.0
    timing.row(name, str(len(deaths)), str(len(lit)), middle, worst, limit=limit_s * 1e3, value=worst)


if __name__ == "__main__":
    main()
