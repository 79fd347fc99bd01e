"""S0, S8: the caustic itself, before any picture is made of it."""

import numpy as np

from device.clock import VirtualClock
from device.optics.diffuser import Grid, caustic_on, grid_for
from device.sim.render import dotted, psf
from device.sim.setup import LED_UM
from device.sim.world import World
from device.spec import OpticsSpec
from device.values import Image
from services.instrument.paper.bench import Bench
from services.instrument.paper.outcome import Claim, Experiment, Outcome, Sheet, Shown, above, below, within
from services.instrument.paper.pictures import plane, trend

PITCH_UM = 5.04
DOT_ON_SENSOR_UM = 49.5  # of 275 um on the screen: 0.18 times (optics.md 1.1)
MIDDLE = 0.6  # of the iris's image, in which contrast is measured
SEEDS = (1, 2, 3, 4)
DISTANCES_MM = (1, 2, 3, 4, 5, 6, 7, 8)
WALK = {15.0: 1.0, 25.0: 1.0, 26.0: 0.879, 28.0: 0.458, 30.0: 0.063}  # optics.md 1.4; the paper's three are 15, 25, 30


def contrast(point: Image, optics: OpticsSpec) -> float:
    """Standard deviation over mean in the middle of the iris's image."""
    rows, cols = (np.arange(n) - n // 2 for n in point.shape)
    middle = np.hypot(rows[:, None], cols[None, :]) * PITCH_UM < MIDDLE * optics.iris_um / 2
    return float(point[middle].std() / point[middle].mean())


def _roomy(optics: OpticsSpec) -> Grid:
    """A grid for the longest distance: one surface for all of them."""
    return grid_for(optics.model_copy(update={"diffuser_to_sensor_um": 1000.0 * max(DISTANCES_MM)}), PITCH_UM)


def run_caustic(bench: Bench) -> Outcome:
    """Contrast raw and through the dot, over the distance, and the likeness of colours; the mean of four diffusers."""
    optics = bench.scene("paper_dots").optics
    assert optics is not None
    grid, over_z = _roomy(optics), {float(z): 0.0 for z in DISTANCES_MM}
    through_dot = 0.0
    for seed in SEEDS:
        bench.say(f"S0: caustic of diffuser {seed}")
        for z in DISTANCES_MM:
            point = caustic_on(grid, optics.model_copy(update={"diffuser_to_sensor_um": 1000.0 * z}), seed, lines=1)
            over_z[z] += contrast(point, optics) / len(SEEDS)
            if z == 6:
                blurred = dotted(point, DOT_ON_SENSOR_UM / PITCH_UM)
                through_dot += contrast(_middle(blurred, point.shape), optics) / len(SEEDS)
    colours = {
        name: caustic_on(grid, optics.model_copy(update={"wavelength_um": um}), SEEDS[0], lines=1)
        for name, um in LED_UM.items()
    }
    near = [over_z[z] / over_z[6] - 1 for z in (5, 6, 7, 8)]
    claims = (
        within("contrast of the caustic at 6 mm", over_z[6], 1.1, 1.5),
        within("contrast through the 275 um dot", through_dot, 0.7, 0.95),
        below("largest change of contrast from 5 to 8 mm", max(map(abs, near)), 0.10, "not sensitive to distance"),
        above("likeness of red and green caustic", _likeness(colours["red"], colours["green"]), 0.95),
        above("likeness of green and blue caustic", _likeness(colours["green"], colours["blue"]), 0.95),
    )
    shown = (
        plane("caustic of a point, green", colours["green"], _bright(colours["green"])),
        plane("through the 275 um dot, as calibrated", dotted(colours["green"], DOT_ON_SENSOR_UM / PITCH_UM)),
        trend(
            "The caustic is sharp over millimetres", "mean of four diffusers, 0.5 degrees, 70 um",
            "diffuser to sensor, mm", "contrast: deviation over mean", {"contrast": over_z},
        ),
    )  # fmt: skip
    return Outcome(claims, shown)


def _middle(image: Image, shape: tuple[int, ...]) -> Image:
    rows, cols = ((have - want) // 2 for have, want in zip(image.shape, shape, strict=True))
    return image[rows : rows + shape[0], cols : cols + shape[1]]


def _bright(point: Image) -> np.ndarray:
    return np.asarray(point > 0.02 * point.max())


def _likeness(one: Image, other: Image) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def run_walk(bench: Bench) -> Outcome:
    """How much light of a single dot passes the iris, dot by dot."""
    spec = bench.scene(
        "paper_dots",
        {"sim.object.kind": "point", "optics.field_deg": 62.0, "sim.eye.surface": "curved", "sim.eye.walks": True},
    )
    setup = World(spec, VirtualClock()).setup(spec.light.colour)
    full = float(psf(setup).sum(dtype=np.float64))
    claims: list[Claim] = []
    shown: list[Shown] = []
    rows = []
    for angle_deg, expected in WALK.items():
        bench.say(f"S8: a dot at {angle_deg:g} degrees")
        point = psf(setup, (angle_deg, 0.0))
        share = float(point.sum(dtype=np.float64)) / full
        said = {15.0: "fully lit", 25.0: "fully lit", 30.0: "6.3 %"}.get(angle_deg, "")
        low, high = expected - 0.002, expected + 0.002
        claims.append(within(f"light of a dot at {angle_deg:g} degrees", share, low, high, said, 4))
        rows.append((f"{angle_deg:g}", f"{share:.4f}", f"{expected:g}", said))
        if angle_deg >= 25:
            shown.append(plane(f"caustic at {angle_deg:g} degrees", point))
    sheet = Sheet(("degrees", "share of the iris lit", "optics notes", "paper"), tuple(rows))
    return Outcome(tuple(claims), tuple(shown), (sheet,))


EXPERIMENTS = (
    Experiment(
        "S0", "The caustic",
        "A diffuser of half a degree makes a caustic with high contrast, at any distance around 6 mm, in every colour.",
        "Figures 1 and 3a; \"precise control of this distance is not required\".", run_caustic,
    ),
    Experiment(
        "S8", "The beam walks over the iris",
        "Up to 25 degrees the beam fills the iris; at 30 degrees hardly any of it is left.",
        "Section \"Optical design\": 6.3 % of the aperture is lit at 30 degrees.", run_walk,
    ),
)  # fmt: skip
