"""S0, S8: experiments on the caustic (the diffuser's light pattern of a point source), without reconstruction."""

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import OpticsSpec
from device.optics.diffuser import Grid, caustic_on, grid_for
from device.optics.illumination import LED
from device.sim.render import convolved_with_disc, psf
from device.sim.world import World
from device.values import Image
from tests.paper.bench import Bench, SimulatedFrame
from tests.paper.outcome import Claim, Experiment, Figure, Outcome, Table, above, attempted, below, within
from tests.paper.pictures import plane, trend
from tests.paper.printed import WIDE_LATTICE
from tests.paper.screen import DOT_MU, apply_floor

PITCH_UM = 5.04
DOT_ON_SENSOR_UM = 49.5  # image of the 275 um dot of the screen, magnification 0.18 (OPTICS.md 1.1)
MIDDLE = 0.6  # share of the iris image in which contrast is measured
SEEDS = (1, 2, 3, 4)
DISTANCES_MM = (1, 2, 3, 4, 5, 6, 7, 8)
WALK = {15.0: 1.0, 25.0: 1.0, 26.0: 0.969, 28.0: 0.624, 30.0: 0.180}  # OPTICS.md 6.3; the paper's three are 15, 25, 30
PRINTED = {15.0: "fully lit", 25.0: "fully lit", 30.0: "6.3 %"}
WALK_GIVEN = "the simulator was given the walk of T"
WHERE = {
    26.0: "; the paper has no number here",
    28.0: "; the paper has no number here",
    30.0: "; the paper's 6.3 % is missed, which the next row counts",
}
TRACED_NOTE = (
    "Why 18 % of the light are left at 30 degrees here, and 21.5 % in T: T takes the beam's outline as the lenses bend "
    "it, which is no circle there; the simulator moves a round beam by the traced walk of its middle. The paper has "
    "6.3 %; T says which distance brings the trace to it."
)


def contrast(point: Image, optics: OpticsSpec) -> float:
    """Return standard deviation over mean of `point` in a central disc, the share MIDDLE of the iris image's width."""
    rows, cols = (np.arange(n) - n // 2 for n in point.shape)
    middle = np.hypot(rows[:, None], cols[None, :]) * PITCH_UM < MIDDLE * optics.iris_um / 2
    return float(point[middle].std() / point[middle].mean())


def _grid_for_all_distances(optics: OpticsSpec) -> Grid:
    """Return a grid for the longest distance, so that one surface serves all distances."""
    return grid_for(optics.model_copy(update={"diffuser_to_sensor_um": 1000.0 * max(DISTANCES_MM)}), PITCH_UM)


def run_caustic(bench: Bench) -> Outcome:
    """Measure contrast over distance and through the dot (four diffusers), and correlation of colours (the first)."""
    optics = bench.scene("paper_dots").optics
    assert optics is not None
    grid, over_z = _grid_for_all_distances(optics), {float(z): 0.0 for z in DISTANCES_MM}
    through_dot = 0.0
    for seed in SEEDS:
        bench.progress(f"S0: caustic of diffuser {seed}")
        for z in DISTANCES_MM:
            point = caustic_on(grid, optics.model_copy(update={"diffuser_to_sensor_um": 1000.0 * z}), seed, lines=1)
            over_z[z] += contrast(point, optics) / len(SEEDS)
            if z == 6:
                blurred = convolved_with_disc(point, DOT_ON_SENSOR_UM / PITCH_UM)
                through_dot += contrast(_middle(blurred, point.shape), optics) / len(SEEDS)
    colours = {
        name: caustic_on(grid, optics.model_copy(update={"wavelength_um": led.wavelength_um}), SEEDS[0], lines=1)
        for name, led in LED.items()
    }
    near = [over_z[z] / over_z[6] - 1 for z in (5, 6, 7, 8)]
    claims = (
        within("contrast of the caustic at 6 mm", over_z[6], 1.1, 1.5),
        within("contrast through the 275 um dot", through_dot, 0.7, 0.95),
        below(
            "largest change of contrast from 5 to 8 mm", max(map(abs, near)), 0.10, "precise control is not required"
        ).adapted(
            "the paper prints no number; read as: contrast within 10 %, for four random surfaces in the simulator"
        ),
        above("likeness of red and green caustic", _correlation(colours["red"], colours["green"]), 0.95),
        above("likeness of green and blue caustic", _correlation(colours["green"], colours["blue"]), 0.95),
    )
    return Outcome(claims, _shown(colours["green"], over_z))


def _shown(green: Image, over_z: dict[float, float]) -> tuple[Figure, ...]:
    return (
        plane("caustic of a point, green", green, _bright(green)),
        plane("through the 275 um dot, as calibrated", convolved_with_disc(green, DOT_ON_SENSOR_UM / PITCH_UM)),
        trend(
            "The caustic is sharp over millimetres",
            "mean of four diffusers, 0.5 degrees, 70 um",
            "diffuser to sensor, mm",
            "contrast: deviation over mean",
            {"contrast": over_z},
        ),
    )


def _middle(image: Image, shape: tuple[int, ...]) -> Image:
    rows, cols = ((have - want) // 2 for have, want in zip(image.shape, shape, strict=True))
    return image[rows : rows + shape[0], cols : cols + shape[1]]


def _bright(point: Image) -> np.ndarray:
    return np.asarray(point > 0.02 * point.max())


def _correlation(left: Image, right: Image) -> float:
    return float(np.corrcoef(left.ravel(), right.ravel())[0, 1])


def run_walk(bench: Bench) -> Outcome:
    """Measure the share of the light of a single dot that passes the iris, at each angle of WALK."""
    spec = bench.scene(
        "paper_dots",
        {"sim.object.kind": "point", "optics.field_deg": 62.0, "sim.eye.surface": "curved", "sim.eye.walks": True},
    )
    setup = World(spec, VirtualClock()).setup(spec.light.colour)
    full = float(psf(setup).sum(dtype=np.float64))
    claims: list[Claim] = []
    shown: list[Figure] = []
    rows = []
    for angle_deg, expected in WALK.items():
        bench.progress(f"S8: a dot at {angle_deg:g} degrees")
        point = psf(setup, (angle_deg, 0.0))
        share = float(point.sum(dtype=np.float64)) / full
        printed = PRINTED.get(angle_deg, "")
        low, high = expected - 0.002, expected + 0.002
        quoted = printed if expected == 1 else ""
        claim = within(f"light of a dot at {angle_deg:g} degrees, by two discs", share, low, high, quoted, 4)
        claims.append(
            claim.put_in(WALK_GIVEN + WHERE.get(angle_deg, "")).limit_from(
                f"{expected:g}: overlap of iris and beam, two discs; +- 0.002 of pixels"
            )
        )
        rows.append((f"{angle_deg:g}", f"{share:.4f}", f"{expected:g}", printed))
        if angle_deg >= 25:
            shown.append(plane(f"caustic at {angle_deg:g} degrees", point))
    paper = attempted("light of a dot at 30 degrees, by the paper", share, 0.053, 0.073, PRINTED[30.0], 4)
    paper = paper.because("the walk is that of T, whose nominal layout is ours").limit_from("the paper's value +- 0.01")
    claims.append(paper)
    sheet = Table(("degrees", "share of the iris lit", "two discs, traced walk", "paper"), tuple(rows))
    return Outcome((*claims, *_cost_of_walk(bench)), tuple(shown), (sheet,), (TRACED_NOTE,))


def _cost_of_walk(bench: Bench) -> tuple[Claim, ...]:
    """Return the claims on what the walk costs the paper's solver, whose PSF is that of the axis, in two ranges."""
    bench.progress("S8: dots over 61 degrees without and with the walk")
    found = []
    for walks in (False, True):
        take = bench.expose("paper_dots", {**WIDE_LATTICE, "sim.eye.surface": "curved", "sim.eye.walks": walks})
        picture = apply_floor(bench.tikhonov(take, DOT_MU), 0.0)
        found.append([pcc_between(take, picture, *reach) for reach in ((0.0, 25.0), (25.0, 31.0))])
    near, far = (still - walking for still, walking in zip(*found, strict=True))
    how = "the walk of T was given, its cost is computed; the paper prints no score"
    return (
        below(
            "PCC lost by the walk, dots within 25 degrees, paper's solver",
            near,
            0.01,
            "LSI approximately maintained",
            4,
        ).adapted(how),
        above("PCC lost by the walk, dots beyond 25 degrees, paper's solver", far, 0.05, "violation of LSI").adapted(
            how
        ),
    )


def pcc_between(take: SimulatedFrame, picture: Image, from_deg: float, to_deg: float) -> float:
    """Return Pearson's correlation of a picture with the truth between two angles to the axis, inside the field."""
    down, right = ((np.arange(n) - (n - 1) / 2) / take.px_per_deg for n in picture.shape)
    angle_deg = np.hypot(down[:, None], right[None, :])
    ring = take.inside & (angle_deg >= from_deg) & (angle_deg < to_deg)
    return _correlation(picture[ring], take.truth[ring])


EXPERIMENTS = (
    Experiment(
        "S0",
        "The caustic",
        "A diffuser of half a degree makes a caustic with high contrast, at any distance around 6 mm, in every colour. "
        "Contrast is the standard deviation over the mean, in the middle 60 % of the iris's image.",
        'Figures 1 and 3a; "precise control of this distance is not required".',
        run_caustic,
    ),
    Experiment(
        "S8",
        "The beam walks over the iris",
        "Up to 25 degrees the beam fills the iris; at 30 degrees a fifth of it is left (T). What that costs is seen in "
        "dots as wide as those of S7 on a curved screen.",
        'Section "Optical design": linear shift-invariance (LSI) is approximately maintained up to 25 degrees and '
        "violated beyond; 6.3 % of the aperture is lit at 30 degrees.",
        run_walk,
    ),
)
