"""T: the paper's ray trace (figure 2) with the makers' data of its lenses, nominal and within tolerances."""

from base64 import b64encode
from math import cos, inf, radians, sin
from typing import NamedTuple

import numpy as np

from device.optics.eye import Relay
from device.optics.light_path import LightPath, load_light_path
from device.optics.ray_trace import Surface, rays
from device.optics.traced_relay import without_rims
from services import resources
from services.plot import document, line, polyline, text
from tests.paper.bench import Bench
from tests.paper.outcome import Claim, Experiment, Figure, Outcome, Table, above, attempted, below, within
from tests.paper.pictures import trend
from tests.paper.relay_figures import (
    BuiltRelay,
    Deviation,
    built_relay,
    built_relays,
    displacement_error,
    f_theta_error,
    field_of_cone_deg,
    paths,
    retina_point,
)

DRAWS, SEED = 60, 23
DRAWN_DEG = {0.0: "s1", 15.0: "s0", 25.0: "s2", 30.0: "s3"}
SCALE, LEFT, AXIS, WIDE, TALL = 5.0, 40.0, 190.0, 1180, 370
PAPER_RING_MM, PAPER_CONE_DEG = 9.5, 24.75
LAYOUT = "the paper prints neither the orientation of the doublets nor their distances: ours"
PAIR = "the paper's value +- 2 %: 1 % of the maker, 1 % for a gap of up to 1 mm"
GUESSED = f"{LAYOUT}; so are the tolerances"
OFF_MM = 0.6  # of the eye, at which the trace has about the paper's 6.3 %
NOTES = (
    "Radii, thicknesses and glasses are the makers' (hardware/optics.toml). The paper gives neither the orientation of "
    "the doublets nor their distances: here the crown faces of each pair face each other, 1 mm apart, which is the "
    "usual pair for a pupil outside the lenses, and the pupil stands in the focus of the first pair. Nothing is fitted "
    "to the paper's angles. Other orientations light 0 to 100 % of the iris at 30 degrees.",
    "The rows on the iris ask where the lenses send the beam; no lens rim and no plate blocks it, in the paper's "
    "sentence as here. The table has the light that passes the rims as well, for a field across the tilt of the plate. "
    "Along its tilt a plate of 25.4 mm, 25 mm before the iris, cuts off the field beyond 20 degrees on one side; so "
    "the paper's 50 degrees need a wider plate in that direction. Width (from the parts list) and thickness (5 mm) are "
    "not checked against the maker's page.",
    "The angle behind the relay is linear in the field angle within 0.5 % up to 28 degrees (largest value of the "
    "table: 0.48 % at 20). The displacement on the flat sensor is the tangent of that angle: 3.4 % more than the "
    "paper's formula at 25 degrees, and 3.2 % less than that of an ideal relay.",
    "The model eye: on a retina of 14 mm radius its beams are within 2.5 dpt of parallel at 25 degrees; on a flat "
    "screen 9 dpt off along the radius. The simulator's flat screen and its beam walk are these curves.",
)


class Built(NamedTuple):
    """95 % intervals over built relays: angle up to which the iris is filled (degrees), share lit at 30 degrees."""

    filled_deg: tuple[float, float]
    lit_at_30: tuple[float, float]


def within_tolerances(path: LightPath) -> Built:
    """Return the 2.5 and 97.5 percentiles over DRAWS relays with random deviations."""
    drawn = np.array(
        [(relay.filled_to_deg(), relay.lit_share(30, count=1000)) for relay in built_relays(path, DRAWS, SEED)]
    )
    low, high = np.round(np.percentile(drawn, [2.5, 97.5], axis=0), 3)
    return Built((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))


def _far_eye_note(path: LightPath) -> str:
    """Return the note on an eye that stands OFF_MM too far from the lenses."""
    far = built_relay(path, Deviation(pupil_axial_mm=OFF_MM))
    return (
        f"An eye {OFF_MM:g} mm too far from the lenses lights {100 * far.lit_share(30):.1f} % of the iris at 30 "
        "degrees: the distance was chosen so that this is about the paper's 6.3 %. The iris is then filled up to "
        f"{far.filled_to_deg():.1f} degrees, and at 25 degrees "
        f"{100 * far.lit_share(25):.1f} % of it are lit: the paper's 25 degrees hold there as well. So both numbers "
        "are within what hand and ruler allow; a narrower comparison needs the paper's distances."
    )


def run_trace(bench: Bench) -> Outcome:
    """Trace the relay, the model eye and the illumination; compare with the paper's angles and its 6.3 %."""
    bench.progress("T: ray trace of the real lenses")
    path = load_light_path(resources.LIGHT_PATH)
    relay = built_relay(path)
    built = within_tolerances(path)
    claims = (*_imaging(relay, built), *_eye(path), *_illumination(relay))
    shares = {float(angle): relay.lit_share(angle) for angle in range(20, 33)}
    shown = (
        _drawing(relay, path),
        trend(
            "The beam leaves the iris",
            "share of the iris's area that a beam lights, traced",
            "field angle, degrees",
            "share lit",
            {"traced": shares, "paper": {15.0: 1.0, 25.0: 1.0, 30.0: 0.063}},
        ),
    )
    return Outcome(claims, shown, (_table(relay, path),), (*NOTES, _far_eye_note(path)))


def _imaging(relay: BuiltRelay, built: Built) -> tuple[Claim, ...]:
    margin_mm = Relay().pupil_margin_mm(relay.pupil_mm)
    return (
        within("focal length of the first pair, mm", relay.first.focal_mm, 36.7, 38.3, "37.5", 2).limit_from(PAIR),
        within("focal length of the second pair, mm", relay.second.focal_mm, 49.0, 51.0, "50", 2).limit_from(PAIR),
        attempted("second pair to iris, mm", relay.iris_at_mm - relay.lamp_surfaces[-1].at_mm, 40, 45, "> 40", 2)
        .because("40.0 without the gap of 1 mm, which is ours, as is the plate's thickness")
        .limit_from("the paper's least"),
        below(
            "walk of the beam at 15 degrees over the margin around the iris",
            relay.walk_mm(15) / margin_mm,
            0.25,
            "no shift within 15 degrees",
            2,
        ).adapted(
            f"the beam moves by {relay.walk_mm(15):.2f} mm where the paper says without shift; read as: a shift that "
            f"the margin around the iris hides; {LAYOUT}"
        ),
        above("share of the iris lit at 25 degrees", relay.lit_share(25), 0.999, "fully illuminated", 4).limit_from(
            "fully: all but one point of 4000"
        ),
        above("share of the iris lit at 25.6 degrees, edge of the 51.2", relay.lit_share(25.64), 0.95, "", 3).ours(),
        within("iris filled up to 25 degrees, among built relays", 25.0, *built.filled_deg, "25", 1)
        .adapted(GUESSED)
        .limit_from(f"95 % of {DRAWS} relays drawn within tolerances are filled up to an angle between these"),
        attempted("share of the iris lit at 30 degrees", relay.lit_share(30), 0.053, 0.073, "6.3 %", 3)
        .because(
            f"the nominal layout is ours; an eye {OFF_MM:g} mm farther off, a distance chosen for that, gives "
            "about 6.3 %"
        )
        .limit_from("the paper's value +- 0.01"),
        within("6.3 % of the iris lit at 30 degrees, among built relays", 0.063, *built.lit_at_30, "6.3 %", 3)
        .adapted(GUESSED)
        .limit_from(
            f"95 % of {DRAWS} relays drawn within tolerances: from almost no light to half of it, so a weak test"
        ),
        *_displacements(relay),
    )


def _displacements(relay: BuiltRelay) -> tuple[Claim, ...]:
    """Return the claims on the displacement on the sensor and on the angle behind the relay."""
    over_formula, over_ideal = displacement_error(relay, 25)
    linear, tangent = f_theta_error(relay, 25)
    return (
        within(
            "traced displacement over s = (f1/f2) f_d theta/2, at 25 degrees",
            1 + over_formula,
            0.95,
            1.05,
            "approximately d + 2s",
            4,
        ).adapted(f"read as: within 5 %; {LAYOUT}"),
        within("traced displacement over that of an ideal relay, at 25 degrees", 1 + over_ideal, 0.95, 1.0, "", 4),
        below("angle behind the relay at 25 degrees, off a linear law", abs(linear), 0.01, "", 4),
        above("angle behind the relay at 25 degrees, off the tangent's law", abs(tangent), 0.02, "", 4),
    )


def _eye(path: LightPath) -> tuple[Claim, ...]:
    curved, flat = retina_point(path, 25), retina_point(path, 25, inf)
    strongest = max(abs(curved.sagittal_dpt), abs(curved.tangential_dpt))
    return (
        below("vergence of a beam at 25 degrees, curved retina, dpt", strongest, 4.0, "collimated from any spot", 2)
        .adapted("read as: within the 4 dpt that the paper tolerates; the distance from pupil to lens is ours")
        .limit_from("the 4 dpt that the paper tolerates"),
        above(
            "vergence at 25 degrees, flat screen over curved retina",
            flat.tangential_dpt / strongest,
            2.0,
            "mismatch of a flat screen",
            2,
        ).adapted(
            "the paper names the mismatch as a possible cause, without a "
            "number; the distance from pupil to lens is ours"
        ),
    )


def _illumination(relay: BuiltRelay) -> tuple[Claim, ...]:
    field_deg = field_of_cone_deg(relay, PAPER_CONE_DEG, PAPER_RING_MM / 2)
    ring_mm = 2 * abs(relay.lamp_ray(PAPER_RING_MM / 2, 0.0)[0])
    return (
        within("field lit by an LED's cone of 24.75 degrees, traced, degrees", field_deg, 32.0, 34.0, "33", 2)
        .put_in("the paper prints no cone: 24.75 is its 33 over f2 / f1; only the 0.3 degrees more are traced")
        .limit_from("the paper's 33 +- 1"),
        within("ring of 9.5 mm at the pupil, mm", ring_mm, 6.9, 7.7, "approximately the pupil, 7.7", 2)
        .adapted(f"read as: up to a tenth smaller than the pupil, so that it enters; {LAYOUT}")
        .limit_from("the pupil's 7.7, less a tenth"),
    )


def _table(relay: BuiltRelay, path: LightPath) -> Table:
    rows = []
    for angle in (5, 10, 15, 20, 25, 28, 30):
        point, screen = retina_point(path, angle), retina_point(path, angle, inf)
        rows.append(
            (
                f"{angle}",
                f"{relay.walk_mm(angle):.2f}",
                f"{relay.lit_share(angle):.3f}",
                f"{relay.passed_share(angle) / relay.passed_share(0):.2f}",
                f"{relay.angle_behind_deg(angle):.2f}",
                f"{100 * f_theta_error(relay, angle)[0]:+.2f}",
                f"{100 * displacement_error(relay, angle)[0]:+.1f}",
                f"{point.sagittal_dpt:+.1f}, {point.tangential_dpt:+.1f}",
                f"{screen.sagittal_dpt:+.1f}, {screen.tangential_dpt:+.1f}",
            )
        )
    head = (
        "field angle, degrees",
        "beam walk, mm",
        "iris lit",
        "light past all rims",
        "angle behind the relay",
        "angle off a linear law, %",
        "displacement off the formula, %",
        "vergence on R 14 mm, sag., tan., dpt",
        "on a flat screen",
    )
    return Table(head, tuple(rows))


def _drawing(relay: BuiltRelay, path: LightPath) -> Figure:
    """Return the scale drawing of the relay in the plane across the plate's tilt, with rays of four field angles."""
    surfaces = without_rims(relay.surfaces)
    iris = Surface(relay.iris_at_mm, inf, 1.0, name="the iris")
    inner = [line(LEFT - 10, AXIS, WIDE - 30, AXIS, "frame"), *map(_outline, relay.lamp_surfaces)]
    for at_mm, half_mm, word in ((0.0, relay.pupil_mm / 2, "pupil"), (relay.iris_at_mm, relay.iris_mm / 2, "iris")):
        x = LEFT + SCALE * at_mm
        inner += [line(x, AXIS + side * SCALE * half_mm, x, AXIS + side * SCALE * 16, "stop") for side in (-1, 1)]
        inner.append(text(x, AXIS + SCALE * 16 + 18, word, "small", "middle"))
    for angle_deg, kind in DRAWN_DEG.items():
        out = radians(angle_deg)
        heights = np.linspace(-relay.pupil_mm / 2, relay.pupil_mm / 2, 5)
        start = np.column_stack([np.zeros(5), heights, np.zeros(5)])
        through = paths((*surfaces, iris), rays(start, np.array([0, sin(out), cos(out)])))
        lines = "".join(polyline(_places(through[:, k]), "ray") for k in range(5))
        inner.append(f'<g class="{kind}">{lines}</g>')
    words = "; ".join(f"{angle:g}" for angle in DRAWN_DEG)
    caption = f"The traced relay to scale: beams of {words} degrees from the pupil to the iris"
    style = (
        ".ray { fill: none; stroke: var(--ink); stroke-width: 1; opacity: .8; }"
        ".stop { stroke: #8a8f98; stroke-width: 3; }"
        ".glass { fill: none; stroke: #4a6b8a; stroke-width: 1.5; }"
    )
    drawn = document(WIDE, TALL, caption, "", [text(24, 28, caption, "title"), *inner], style)
    return Figure(caption, f"data:image/svg+xml;base64,{b64encode(drawn.encode()).decode()}", wide=True)


def _outline(surface: Surface) -> str:
    """Return the section of a spherical surface as an SVG line."""
    heights = np.linspace(-surface.clear_mm / 2, surface.clear_mm / 2, 41)
    sag = surface.radius_mm - np.sign(surface.radius_mm) * np.sqrt(surface.radius_mm**2 - heights**2)
    places = np.column_stack([np.zeros(41), heights, surface.at_mm + sag])
    return polyline(_places(places), "glass")


def _places(places_mm: np.ndarray) -> list[tuple[float, float]]:
    return [(LEFT + SCALE * z, AXIS - SCALE * y) for _, y, z in places_mm]


EXPERIMENTS = (
    Experiment(
        "T",
        "The real lenses, traced",
        "Rays through LB1761-A, 2 x AC508-075-A, 2 x AC508-100-A and the plate, from the makers' radii and glasses.",
        "Figure 2 (Zemax): no shift within 15 degrees, iris filled to 25, 6.3 % of its area lit at 30.",
        run_trace,
        LAYOUT,
    ),
)
