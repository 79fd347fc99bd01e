"""`make bench-kills`: duration of light after the process that holds the lamp is killed, 200 times."""

import random
import signal

import numpy as np

from tests.bench import timing
from tests.ports.emulators.kills import KillResult, LitProcess
from tests.ports.emulators.wires import emulated_buses

KILLS, STOPS = 200, 20
LEASE_S, DARK_S = 0.4, 0.1
ENDS = {"hang": LEASE_S + DARK_S, "raise": DARK_S, "exit": DARK_S}


def main() -> None:
    """Kill at random times of random phases, and print the result."""
    timing.head("dark after (emulated bus)", "times", "lit then", "median ms", "worst ms", "limit")
    draw = random.Random(1)
    for how, times, limit_s in ((signal.SIGKILL, KILLS, DARK_S), (signal.SIGSTOP, STOPS, LEASE_S + DARK_S)):
        print_row(
            how.name,
            [LitProcess(emulated_buses(), LEASE_S).kill(how, draw.uniform(0, 0.5)) for _ in range(times)],
            limit_s,
        )
    for end, limit_s in ENDS.items():
        print_row(
            f"{end}, with the lamp on",
            [LitProcess(emulated_buses(), LEASE_S, end).await_end(end) for _ in range(5)],
            limit_s,
        )


def print_row(name: str, deaths: list[KillResult], limit_s: float) -> None:
    """Print one line; the median is over the kills with the lamp lit."""
    lit = [death.dark_after_s * 1e3 for death in deaths if death.was_lit]
    worst = max(death.dark_after_s * 1e3 for death in deaths)
    middle = float(np.median(lit)) if lit else 0.0
    timing.row(name, str(len(deaths)), str(len(lit)), middle, worst, limit=limit_s * 1e3, value=worst)


if __name__ == "__main__":
    main()
