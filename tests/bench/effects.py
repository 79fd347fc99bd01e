"""Two scenes with the effects that each calls for, beside all effects: `make effects`.

Prints for each scene the number of effects, the time of one frame both ways with their ratio, the difference of the
pictures, over the mean light, and the correlation of each with the truth; draws the pictures.
"""

import sys
from base64 import b64decode
from pathlib import Path

import numpy as np

from device.clock import SystemClock, VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import pcc
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Image, Mask
from tests import scenes
from tests.paper.pictures import side_by_side
from tests.simulated import SCENES, exposed_counts, world

SHOWN = ("healthy", "drifting_eye")


def timed_frame(of: World) -> tuple[np.ndarray, float]:
    """Return one lit frame and the seconds that it took, the scene's set-up included."""
    clock = SystemClock()
    begin_s = clock.now_s()
    return exposed_counts(of), clock.now_s() - begin_s


def compare(name: str) -> list[tuple[Image, Mask]]:
    """Print the figures of a scene; return its two pictures, each with the field."""
    spec = load_head(SCENES / f"{name}.toml")
    worlds = world(spec), world(spec, everything=True)
    calibration = simulated_calibration(worlds[0])  # the caustic is traced once, outside of the measured time
    make = Reconstructor(calibration, worlds[0].shape, scenes.PLANNER, VirtualClock(), refract=False, timed=False)
    inside = field_mask(worlds[0].shape, field_radius_px(calibration))
    pictures, seconds, likeness = [], [], []
    for of in worlds:
        of.frames = 0  # the same noise in both
        counts, frame_s = timed_frame(of)
        pictures.append(make(counts).picture.copy())
        seconds.append(frame_s)
        likeness.append(pcc(pictures[-1].astype(float), of.truth(spec.light.colour).astype(float), inside))
    simulated = sum(effect.simulated for effect in worlds[0].plan)
    off = pictures[1] * (pictures[0][inside].mean() / pictures[1][inside].mean()) - pictures[0]
    print(
        f"{spec.name}: {simulated} of {len(worlds[0].plan)} effects in {seconds[0]:.2f} s, all in {seconds[1]:.2f} s, "
        f"{seconds[1] / seconds[0]:.1f} times as long; "
        f"the pictures differ by {off[inside].std() / pictures[0][inside].mean():.2%} of the mean (rms), PCC with "
        f"the truth is {likeness[0]:.3f} and {likeness[1]:.3f}",
        flush=True,
    )
    return [(picture, inside) for picture in pictures]


def main(file: Path) -> None:
    """Write the pictures of SHOWN, scene after scene in one row, as PNG."""
    rows = [picture for name in SHOWN for picture in compare(name)]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b64decode(side_by_side("", file.name, rows).address.split(",", 1)[1]))
    print(f"{file}: from the left {' and '.join(SHOWN)}, each as planned and with all effects")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
