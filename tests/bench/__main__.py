"""`make bench`: speed and accuracy on this machine, with limits that a change must keep.

Absolute times hold for one machine on one day; a ratio within one run shows the overhead of the code. One part alone:
`python -m tests.bench speed`, `camera`, `deadline`, `peers`, `simulator`, `calibration`, `fitness`, `scaling`,
`preview`, `viewer` or `lean`.
"""

import os
import platform
import resource
import sys
from pathlib import Path

from device.config.head_file import load_head
from device.recon.model.fft_plans import Planner, processor_name
from device.sim.scene_files import simulate_exposure
from tests.bench import calibration, camera, deadline, fitness, lean, peers, preview, scaling, simulator, speed, viewer

PLANS = Path.home() / ".cache" / "diffuscope"
SCENE = Path("device/sim/scenes/diabetic.toml")
PARTS = (
    "speed",
    "camera",
    "deadline",
    "peers",
    "simulator",
    "calibration",
    "fitness",
    "scaling",
    "preview",
    "viewer",
    "lean",
)


def main(parts: list[str]) -> None:
    """Run the named parts, by default all."""
    if unknown := set(parts) - set(PARTS):
        sys.exit(f"there is no part called {sorted(unknown)[0]}; choose from {', '.join(PARTS)}")
    wanted = parts or list(PARTS)
    print(f"{processor_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {platform.platform()}")
    planner = Planner(PLANS)
    if {"speed", "peers"} & set(wanted):
        _on_one_scene(wanted, planner)
    if "camera" in wanted:
        camera.camera()
    if "simulator" in wanted:
        simulator.simulator()
    for name, part in (
        ("deadline", deadline.deadlines),
        ("calibration", calibration.calibration),
        ("fitness", fitness.fitness),
    ):
        if name in wanted:
            part(planner)
    if "scaling" in wanted:
        scaling.scaling(PLANS)
    for name, alone in {"preview": preview.preview, "viewer": viewer.viewer, "lean": lean.lean}.items():
        if name in wanted:
            alone()
    print(f"\npeak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def _on_one_scene(wanted: list[str], planner: Planner) -> None:
    scene = simulate_exposure(load_head(SCENE))
    if "speed" in wanted:
        speed.closed_forms(scene, planner)
        speed.rounds(scene, planner)
        speed.refraction(scene, planner)
        speed.libraries()
    if "peers" in wanted:
        peers.peers(scene, planner)


if __name__ == "__main__":
    main(sys.argv[1:])
