"""Accuracy against time of the simulated head on this computer, as the page shows it at first: `make frontier`.

Writes the measurement and its plot, which README shows, to `services/instrument/simulated_frontier`, and a panel for
each element at the light of a human eye to `hardware/pictures`. Measure on an idle computer.
"""

from pathlib import Path

from device.clock import SystemClock
from device.config.head_file import load_head
from device.recon.methods import METHODS
from services import resources
from services.instrument.accuracy_explorer import (
    BUDGET_S,
    SCENE,
    SHIPPED,
    SHIPPED_HEAD,
    simulated_head,
    write_measurement,
)
from services.research.frontier import measure_frontier, measure_scene, scene_case
from services.research.frontier_plot import draw_heads
from services.research.named_files import scene_file
from services.running_time import say

REPEATS = 7
ELEMENTS = ("imx296", "imx296_lenslets", "imx296_control")  # in the light of one ring
PANELS = Path(__file__).parents[2] / "hardware" / "pictures" / "frontier-elements.svg"


def main() -> None:
    """Measure and write both files; the FFT plans are those of this user."""
    plans = resources.fft_plans() or Path("out")
    spec = simulated_head(load_head(SHIPPED_HEAD), load_head(SCENE))
    measured, plot = measure_scene(spec, plans, BUDGET_S, REPEATS, say)
    write_measurement(SHIPPED, measured, plot, SystemClock())
    say(f"{SHIPPED}: {len(measured.points)} points of {measured.scene}")
    draw_elements(plans)


def draw_elements(plans: Path) -> None:
    """Measure a human eye behind each element, and write the panels."""
    methods = {name: method for name, method in METHODS.items() if name != "open"}  # the field is known
    scenes = [load_head(scene_file(f"human_eye_{name}")) for name in ELEMENTS]
    found = [
        measure_frontier(scene_case(scene, bursts=True), plans, BUDGET_S, REPEATS, say, methods) for scene in scenes
    ]
    PANELS.write_text(draw_heads(found), encoding="utf-8")
    say(f"{PANELS}: {len(found)} heads")


if __name__ == "__main__":
    main()
