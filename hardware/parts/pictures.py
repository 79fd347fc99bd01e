"""The pictures of the assembly guide, drawn from the models that are printed: `make part-pictures`."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from math import copysign, sqrt
from pathlib import Path

from build123d import Part

from device.optics import field_extent
from device.optics.light_path import relay_of
from device.optics.ray_trace import Surface
from device.optics.traced_relay import traced_relay
from hardware.parts import assembly, bought
from hardware.parts.dimensions import Dimensions
from hardware.parts.lens_drawing import lenslets
from hardware.parts.sheet import MEASURE, Sheet, labels
from hardware.parts.view import Drawn, Offset, View, cut
from services.plot import line, text

BESIDE = {"LED cap", "LED cover", "LED matrix"}  # cut where LEDs of the ring are
UPRIGHT = {"LED film", *BESIDE}  # taken apart upwards
BOUGHT = {
    "lens tubes": "metal",
    "beam splitter": "glass",
    "LED matrix": "board",
    "LED film": "glass",
    "lever": "metal",
    "polariser film": "glass",
    "diffuser": "glass",
    "camera": "board",
    "eye lens": "glass",
    "pinhole": "metal",
    "retina chart": "glass",
}
AWAY: dict[str, Offset] = {  # how far each part is drawn from its place
    "lens tubes": (0, 0, -60),
    "tube flange": (0, 0, -38),
    "plate lid": (-58, 0, 0),
    "beam splitter": (-34, 0, 0),
    "LED film": (0, 14, 0),
    "LED cap": (0, 34, 0),
    "LED matrix": (0, 54, 0),
    "LED cover": (0, 72, 0),
    "polariser ring": (0, 0, 26),
    "polariser film": (0, 0, 36),
    "diffuser cell": (0, 0, 56),
    "lever": (0, 22, 56),
    "iris": (0, 0, 66),
    "diffuser": (0, 0, 74),
    "retaining ring": (0, 0, 84),
    "sensor spacer": (0, 0, 96),
    "camera": (0, 0, 112),
    "camera cover": (0, 0, 128),
}
EYE_AWAY: dict[str, Offset] = {
    "eye collar": (0, 0, 30),
    "eye lens": (0, 0, -62),
    "step ring": (0, 0, -30),
    "pinhole": (0, 0, -60),
    "pinhole piston": (0, 0, -70),
}
CHART_AWAY: dict[str, Offset] = {
    "eye collar": (0, 0, 30),
    "eye lens": (0, 0, -62),
    "step ring": (0, 0, -30),
    "retina chart": (0, 0, -56),
    "chart piston": (0, 0, -70),
}
OBLIQUE = View((-0.60, 0.52, 0.24))
FROM_FRONT = View((-0.60, 0.45, -0.45))
STEPS: dict[str, tuple[int, View, dict[str, Offset]]] = {  # a step of the guide: its number, what joins what
    "iris": (
        2,
        OBLIQUE,
        {"diffuser cell": (0, 0, 0), "iris": (0, 0, 22), "diffuser": (0, 0, 34), "retaining ring": (0, 0, 48)},
    ),
    "sensor": (
        3,
        OBLIQUE,
        {"diffuser cell": (0, 0, 0), "sensor spacer": (0, 0, 22), "camera": (0, 0, 44), "camera cover": (0, 0, 66)},
    ),
    "splitter": (4, OBLIQUE, {"splitter block": (0, 0, 0), "beam splitter": (-48, 0, 0), "plate lid": (-78, 0, 0)}),
    "polariser": (
        5,
        FROM_FRONT,
        {
            "diffuser cell": (0, 0, 0),
            "polariser film": (0, 0, -20),
            "polariser ring": (0, 0, -34),
            "lever": (0, 16, 0),
            "splitter block": (0, 0, -62),
        },
    ),
    "ring": (
        7,
        OBLIQUE,
        {
            "splitter block": (0, 0, 0),
            "LED film": (0, 14, 0),
            "LED cap": (0, 34, 0),
            "LED matrix": (0, 54, 0),
            "LED cover": (0, 72, 0),
        },
    ),
    "tubes": (8, FROM_FRONT, {"splitter block": (0, 0, 0), "tube flange": (0, 0, -34), "lens tubes": (0, 0, -66)}),
}


def pictures(d: Dimensions, folder: Path) -> list[Path]:
    """Draw them all; answers what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, picture in PICTURES.items():
        (file := folder / f"parts-{name}.svg").write_text(picture(d), encoding="utf-8")
        written.append(file)
    return written


def exploded(d: Dimensions) -> str:
    """Every part of the head beside its place, along the axes on which it is put together."""
    parts = {name: part for name, part in assembly.head(d).items() if name != "dust cap"}
    return _exploded("The head, taken apart", parts, AWAY, 4.2)


def eye(d: Dimensions) -> str:
    """The calibration's eye."""
    return _exploded("The eye for the calibration, taken apart", assembly.eye(d), EYE_AWAY, 4.2)


def chart_eye(d: Dimensions) -> str:
    """The model eye with its retina chart."""
    return _exploded("The model eye with its retina chart, taken apart", assembly.chart_eye(d), CHART_AWAY, 4.2)


def step(name: str, d: Dimensions) -> str:
    """One step of the guide: its parts on their way to where they belong."""
    number, view, away = STEPS[name]
    shapes = {part: one.shape for part, one in assembly.printed().items()} | bought.HEAD
    parts = {part: shapes[part](d) for part in away}
    return _exploded(f"Step {number}, {name}", parts, away, 3.6, view, beside=90 if UPRIGHT & set(away) else 0)


def relay(d: Dimensions) -> str:
    """The lenses cut along their axis, with the tube at its stop: which face looks where, and distances."""
    faces = traced_relay(d.path).lamp_surfaces
    half = d.path.relay.lens_mm / 2
    pupil = faces[0].at_mm - d.pupil_to_glass_mm
    iris = faces[-1].at_mm - d.tube_stop_z_mm
    lenses = [_lens(faces[first : first + 3], half) for first in range(0, len(faces), 3)]
    planes = [Drawn("", z, -half, z, half) for z in (pupil, iris)]
    sheet = Sheet("Step 1, relay: the lenses cut along their axis", [*lenses, *planes], 4.0)
    last = len(faces) // 2 - 1
    second = len(faces) // 2
    spans = [(pupil, faces[0].at_mm), (faces[last].at_mm, faces[second].at_mm), (faces[-1].at_mm, iris)]
    over = []
    for begin, end in spans:
        over.append(sheet.measure((begin, 0), (end, 0)))
        x, y = sheet.at(((begin + end) / 2, 0))
        over.append(text(x, y - 8, f"{end - begin:.1f} mm", MEASURE, "middle"))
    for words, z in (("pupil of the eye", pupil), ("iris", iris)):
        (x, top) = sheet.at((z, half))
        (_, bottom) = sheet.at((z, -half))
        over += [line(x, top, x, bottom, "measure"), text(x, top - 8, words, "small name", "middle")]
    for words, first, end in (("doublets 75 mm", 0, last), ("doublets 100 mm", second, -1)):
        x, y = sheet.at(((faces[first].at_mm + faces[end].at_mm) / 2, half))
        over.append(text(x, y - 26, words, "small name", "middle"))
    return sheet.document([one.svg for one in lenses], over)


def _lens(faces: Sequence[Surface], half_mm: float) -> Drawn:
    """One cemented doublet: outlines of its two glasses between three faces."""
    curves = [
        [
            (face.at_mm + face.radius_mm - copysign(sqrt(face.radius_mm**2 - y**2), face.radius_mm), y)
            for y in (half_mm * k / 24 for k in range(-24, 25))
        ]
        for face in faces
    ]
    outlines = [_outline([*left, *reversed(right)]) for left, right in pairwise(curves)]
    ends = [z for curve in curves for z, _ in curve]
    svg = "".join(f'<path class="glass" d="{outline}"/>' for outline in outlines)
    return Drawn(svg, min(ends), -half_mm, max(ends), half_mm)


def _exploded(
    title: str, parts: dict[str, Part], away: dict[str, Offset], px_per_mm: float, view: View = OBLIQUE, beside: int = 0
) -> str:
    """Parts away from their places, with names; `beside` px of room for names to the right of all parts."""
    drawn = {name: view.seen(part, _kind(name), away.get(name, (0, 0, 0))) for name, part in parts.items()}
    behind = sorted(drawn, key=lambda name: drawn[name].depth)
    sheet = Sheet(title, drawn.values(), px_per_mm, beside=beside)
    body = [drawn[name].svg for name in behind]
    return sheet.document(body, labels(sheet, drawn, frozenset(parts) & UPRIGHT))


def section(d: Dimensions) -> str:
    """The head cut along its axis, its LEDs where the ring has some, with light and the distances that count."""
    parts = {name: part for name, part in assembly.head(d).items() if name != "dust cap"}
    beside = min((x for x, _ in d.ring_places_mm), key=abs)
    cuts = {name: cut(part, _kind(name), at_x_mm=beside if name in BESIDE else 0) for name, part in parts.items()}
    drawn = {name: face for name, face in cuts.items() if face is not None}
    sheet = Sheet("The head, cut along its axis", drawn.values(), 9.0)
    light = [f'<path class="light" d="{places}"/>' for places in (_light(d), *_led_light(d, beside))]
    return sheet.document([*(face.svg for face in drawn.values()), *light], labels(sheet, drawn) + _measures(sheet, d))


def _light(d: Dimensions) -> str:
    """The field's outermost light: from the plate's front through the iris to the sensor."""
    relay = relay_of(d.path, d.path.optics)
    field = d.path.optics.field_deg
    begin = d.block_z_mm[0]
    before = relay.beam_before_iris_mm(field, -begin) / 2
    iris = d.iris_mm / 2
    end = d.image_z_mm
    sensor = d.iris_mm / 2 + field_extent.half_shift_tan_mm(relay, field)
    upper = [(0, iris), (end, sensor), (end, -sensor), (0, -iris)]
    plate = d.plate_z_mm
    at_plate = relay.beam_before_iris_mm(field, -d.plate_z_mm) / 2
    low = d.lens_y_mm - before
    high = d.lens_y_mm + before
    return _outline([*upper, (plate, -at_plate), (begin, low), (begin, high), (plate, at_plate)])


def _led_light(d: Dimensions, x_mm: float) -> list[str]:
    """What the cap lets out of each LED in this cut, down to the plate or to the bore around it."""
    slope = d.led_hole_mm / 2 / (d.led_y_mm - d.cap_end_y_mm)
    long = d.led_y_mm - d.lens_y_mm
    bore = d.plate_seen_mm / 2
    outlines = []
    for off in (z - d.plate_z_mm for x, z in d.ring_places_mm if x == x_mm):
        places = [(off, long)]
        for side in (1, -1):
            end = (long - off) / (1 + side * slope)  # the plate is where both coordinates from its middle agree
            met = off + side * slope * end
            wall = side * bore, long - (bore - side * off) / slope
            reached = [(met, met)] if abs(met) <= bore else [wall, (side * bore, side * bore)]
            places += reached if side == 1 else reversed(reached)
        outlines.append(_outline([(d.plate_z_mm + z, d.lens_y_mm + y) for z, y in places]))
    return outlines


def _outline(places: list[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{z:.1f} {-y:.1f}" for z, y in places) + "Z"


def _measures(sheet: Sheet, d: Dimensions) -> list[str]:
    """Three distances of `optics.toml`, between the planes that they join."""
    optics = d.path.optics
    relay = d.path.relay
    deep = -8.0
    plate = d.plate_z_mm
    image = d.image_z_mm
    lines = [
        sheet.measure((plate, deep), (0, deep)),
        sheet.measure((0, deep), (image, deep)),
        sheet.measure((plate, d.lens_y_mm), (plate, d.led_y_mm)),
    ]
    splitter = f"{relay.splitter_to_iris_mm:g} mm"
    air = f"{optics.diffuser_to_sensor_um / 1000:g} mm in air"
    x, y = sheet.at((plate, d.led_y_mm * 0.6))
    return [
        *lines,
        text(*sheet.at((plate / 2, deep - 1.8)), splitter, MEASURE, "middle"),
        text(x + 6, y, splitter, MEASURE),
        text(*sheet.at((image / 2, deep - 2.6)), air, MEASURE, "middle"),
    ]


def printed(d: Dimensions) -> str:
    """Every printed part as it lies on the printer's bed."""
    view = View((-0.5, -0.62, 0.75), (0, 0, 1))
    cols = 5
    wide = 88.0
    high = 88.0
    drawn = []
    names = list(assembly.printed())
    for i, part in enumerate(assembly.printed().values()):
        seen = view.seen(part.on_the_bed(d), "printed")
        x = (i % cols) * wide - seen.middle[0]
        y = -(i // cols) * high - seen.middle[1]
        box = seen.left + x, seen.low + y, seen.right + x, seen.high + y
        drawn.append(Drawn(f'<g transform="translate({x:.1f} {-y:.1f})">{seen.svg}</g>', *box))
    sheet = Sheet("What is printed, as it lies on the bed", drawn, 2.4, top=40)
    words = []
    for i, name in enumerate(names):
        x, y = sheet.at(((i % cols) * wide, -(i // cols) * high - high / 2))
        words.append(text(x, y + 4, name, "small", "middle"))
    return sheet.document([one.svg for one in drawn], words)


def _kind(name: str) -> str:
    return BOUGHT.get(name, "printed")


PICTURES: dict[str, Callable[[Dimensions], str]] = {
    "exploded": exploded,
    "section": section,
    "eye": eye,
    "chart-eye": chart_eye,
    "printed": printed,
    "step-relay": relay,
    "lenslets": lenslets,
    **{f"step-{name}": partial(step, name) for name in STEPS},
}
