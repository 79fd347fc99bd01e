"""Accuracy against time of the simulated head on this computer, as the page shows it at first: `make frontier`.

Writes the measurement and its plot, which README shows, to `services/instrument/simulated_frontier`. Measure on an idle
computer.
"""

from pathlib import Path

from device.clock import SystemClock
from device.config.head_file import load_head
from services import resources
from services.instrument.accuracy_explorer import (
    BUDGET_S,
    SCENE,
    SHIPPED,
    SHIPPED_HEAD,
    simulated_head,
    write_measurement,
)
from services.research.frontier import measure_scene
from services.running_time import say

REPEATS = 7


def main() -> None:
    """Measure and write both files; the FFT plans are those of this user."""
    plans = resources.fft_plans() or Path("out")
    spec = simulated_head(load_head(SHIPPED_HEAD), load_head(SCENE))
    measured, plot = measure_scene(spec, plans, BUDGET_S, REPEATS, say)
    write_measurement(SHIPPED, measured, plot, SystemClock())
    say(f"{SHIPPED}: {len(measured.points)} points of {measured.scene}")


if __name__ == "__main__":
    main()
