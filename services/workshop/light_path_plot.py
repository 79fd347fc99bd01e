"""Scale drawing (SVG) of the light path of one design; below it the part from iris to sensor, five times larger."""

from itertools import pairwise
from math import hypot

from device.optics.budget import Design, OpticalBudget, Side, optical_budget
from device.optics.light_path import Place, led_ray_mm, planes_mm, ray_mm
from device.optics.matrix import led_positions_mm, ring
from services.plot import LETTER_PX, LINE_PX, Box, document, line, polyline, text

STYLE_HERE = """
  .part { fill: none; stroke: #1d2330; stroke-width: 2; } .glass { fill: #cfe3f5; stroke: #4a6b8a; }
  .axis { stroke: #8a8f98; stroke-dasharray: 9 3 2 3; } .lead { stroke: #b4b9c2; }
  .ray { fill: none; stroke: var(--ink); stroke-width: 1.1; opacity: .8; }
  @media (prefers-color-scheme: dark) { .part { stroke: #eceff4; } .glass { fill: #223a52; stroke: #8fb4d8; } }
"""
SCALE, CLOSE = 5.0, 25.0  # pixels per millimetre of the drawing and of the enlargement
WIDE, TALL = 1180, 870
LEFT, AXIS, CLOSE_LEFT, CLOSE_AXIS = 180.0, 280.0, 190.0, 670.0
TOP = 128.0  # y of the lowest row of labels in px, and the number of rows above
ROWS = 5


def draw_light_path(design: Design) -> str:
    """Return the SVG with lenses, rays of the field's centre and edge, light of one LED, iris, sensor and labels."""
    budget = optical_budget(design)
    title = f"Light path of {design.title}"
    description = (
        f"A field of {budget.field_deg:g} degrees leaves the eye, passes two lenses, and meets the sensor"
        f" {budget.extent_mm:.2f} mm wide; its short side has {budget.short.sensor_mm:.2f} mm."
    )
    inner = [*_parts(design, budget), *_rays(design), *_enlargement(design, budget), *_labels(_part_labels(design))]
    return document(WIDE, TALL, title, description, [text(24, 32, title, "title"), *inner], STYLE_HERE)


def _at(place: Place) -> Place:
    return LEFT + SCALE * place[0], AXIS + SCALE * place[1]


def _stroke(kind: str, *places: Place) -> str:
    return polyline(map(_at, places), kind)


def _parts(design: Design, budget: OpticalBudget) -> list[str]:
    relay = design.relay
    path = design.path.relay
    first, second, iris, sensor = planes_mm(relay)
    plate = iris - path.splitter_to_iris_mm
    half = path.splitter_mm / 2**1.5
    lens = path.lens_mm / 2
    board = design.chain.pitch_mm * design.chain.cols / 2
    long = budget.long.sensor_mm / 2
    pupil = design.pupil_mm / 2
    x, y = _at((-design.eye_mm / 2, 0))
    return [
        f'<circle class="part" cx="{x:.1f}" cy="{y:.1f}" r="{SCALE * design.eye_mm / 2:.1f}"/>',
        _stroke("axis", (-design.eye_mm, 0), (sensor + 4, 0)),
        _stroke("axis", (plate, 0), (plate, path.splitter_to_iris_mm)),
        *(_lens(at, lens) for at in (first, second)),
        _stroke("part", (plate - half, -half), (plate + half, half)),
        *(_stroke("part", (0, side * pupil), (0, side * (pupil + 3))) for side in (-1, 1)),
        *(_stroke("part", (iris, side * relay.iris_mm / 2), (iris, side * 9)) for side in (-1, 1)),
        _stroke("part", (sensor, -long), (sensor, long)),
        _stroke("part", (plate - board, path.splitter_to_iris_mm), (plate + board, path.splitter_to_iris_mm)),
        _ring_label(design, plate - board),
        *_distances(design),
    ]


def _ring_label(design: Design, board_mm: float) -> str:
    """Return the label left of the LED board: diameter of the LED ring in mm, cap, polariser."""
    diameters = {round(2 * hypot(*led_positions_mm(design.chain)[led]), 2) for led in ring(design.chain)}
    size = " and ".join(f"{diameter_mm:.2f}" for diameter_mm in sorted(diameters))
    x, y = _at((board_mm, design.path.relay.splitter_to_iris_mm))
    return text(x - 6, y + 14, f"ring of {size} mm, cap, polariser", "small", "end")


def _lens(at_mm: float, half_mm: float) -> str:
    x, y = _at((at_mm, 0))
    return f'<ellipse class="glass" cx="{x:.1f}" cy="{y:.1f}" rx="9" ry="{SCALE * half_mm:.1f}"/>'


def _distances(design: Design) -> list[str]:
    """Return the dimension lines below the parts: pupil to first lens, second lens, iris; lengths in mm."""
    y = AXIS + 170
    marks = (0.0, *planes_mm(design.relay)[:3])
    out = []
    for start, end in pairwise(marks):
        a = _at((start, 0))[0]
        b = _at((end, 0))[0]
        out += [line(a, y, b, y, "frame"), *(line(x, y - 5, x, y + 5, "frame") for x in (a, b))]
        out.append(text((a + b) / 2, y + 18, f"{end - start:g} mm", "small", "middle"))
    return out


def _rays(design: Design) -> list[str]:
    relay = design.relay
    half_deg = design.optics.field_deg / 2
    edge_mm = relay.iris_at_eye_mm / 2
    cone_deg = relay.led_cone_deg(design.optics.field_deg) / 2
    out = []
    for kind, angle_deg in (("s1", 0.0), ("s3", half_deg), ("s2", -half_deg)):
        rays = (ray_mm(relay, design.eye_mm, height_mm, angle_deg) for height_mm in (-edge_mm, 0, edge_mm))
        out += [f'<g class="{kind}">', *(_stroke("ray", *places) for places in rays), "</g>"]
    led_mm = max(hypot(*led_positions_mm(design.chain)[led]) for led in ring(design.chain))
    lit = (led_ray_mm(design.path, relay, led_mm, angle_deg) for angle_deg in (-cone_deg, 0, cone_deg))
    return [*out, '<g class="s0">', *(_stroke("ray", *places) for places in lit), "</g>"]


def _part_labels(design: Design) -> list[tuple[Place, str]]:
    """Return for each part on the axis its top as (x, y) in mm, and the text of its label."""
    relay = design.relay
    path = design.path.relay
    first, second, iris, sensor = planes_mm(relay)
    plate = iris - path.splitter_to_iris_mm
    top = -path.lens_mm / 2
    half = path.splitter_mm / 2**1.5
    return [
        ((-design.eye_mm / 2, -design.eye_mm / 2), f"eye, {design.eye_mm:g} mm"),
        ((0, -design.pupil_mm / 2 - 3), f"pupil {design.pupil_mm:g} mm"),
        ((first, top), f"first lens, f {relay.first_mm:g} mm"),
        ((2 * first, -relay.first_mm * 0.31), "image of the retina"),
        ((second, top), f"second lens, f {relay.second_mm:.4g} mm"),
        ((plate - half, -half), "beam splitter"),
        ((iris, -9), f"iris {relay.iris_mm:g} mm, diffuser"),
        ((sensor, -9.5), "sensor"),
    ]


def _labels(named: list[tuple[Place, str]]) -> list[str]:
    """Return each label with its leader line, in the lowest row with no overlap of other labels and leader lines."""
    taken: list[Box] = []
    out = []
    leads = [_at(place)[0] for place, _ in named]
    for place, words in named:
        x, y = _at(place)
        others = [lead for lead in leads if lead != x]
        tries = [(_box(x, row, anchor, words), anchor) for row in range(ROWS) for anchor in ("middle", "start", "end")]
        free = (position for position in tries if not any(position[0][0] < lead < position[0][2] for lead in others))
        box, anchor = next(
            (position for position in free if not any(_overlap(position[0], other) for other in taken)), tries[-1]
        )
        taken.append(box)
        out += [line(x, box[3] + 1, x, y - 3, "lead"), text(x, box[3] - 3, words, "small", anchor)]
    return out


def _box(x: float, row: int, anchor: str, words: str) -> Box:
    wide = len(words) * LETTER_PX
    bottom = TOP - row * (LINE_PX + 5)
    left = x - {"middle": wide / 2, "start": 0, "end": wide}[anchor]
    return left - 3, bottom - LINE_PX, left + wide + 3, bottom


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _enlargement(design: Design, budget: OpticalBudget) -> list[str]:
    """Return the enlargement from iris to sensor: rays of the field's centre and edges.

    Bars beside the sensor compare its two sides with the extent of the light.
    """
    relay = design.relay
    half_deg = design.optics.field_deg / 2
    iris, sensor = planes_mm(relay)[2:]
    x = CLOSE_LEFT
    far = CLOSE_LEFT + CLOSE * relay.diffuser_to_sensor_mm
    out = [text(24, CLOSE_AXIS - 158, "From the iris to the sensor, five times larger")]
    for kind, angle_deg in (("s1", 0.0), ("s3", half_deg), ("s2", -half_deg)):
        edges = [ray_mm(relay, design.eye_mm, side * relay.iris_at_eye_mm / 2, angle_deg)[-2:] for side in (-1, 1)]
        rays = (line(x, CLOSE_AXIS + CLOSE * a, far, CLOSE_AXIS + CLOSE * b, "ray") for (_, a), (_, b) in edges)
        out += [f'<g class="{kind}">', *rays, "</g>"]
    for side in (-1, 1):
        edge = CLOSE_AXIS + side * CLOSE * relay.iris_mm / 2
        out.append(line(x, edge, x, CLOSE_AXIS + side * 150, "part"))
    out.append(text(x - 8, CLOSE_AXIS + 4, f"d = {relay.iris_mm:g} mm", "small", "end"))
    out.append(text((x + far) / 2, CLOSE_AXIS + 180, f"z = {sensor - iris:g} mm", "small", "middle"))
    sides = (
        ("s4", budget.long.sensor_mm, f"long side {_side_label(budget.long)}"),
        ("s0", budget.short.sensor_mm, f"short side {_side_label(budget.short)}"),
        ("s1", budget.extent_tan_mm, f"the light {budget.extent_tan_mm:.2f} mm; d + 2s {budget.extent_mm:.2f} mm"),
    )
    for number, (kind, side_mm, words) in enumerate(sides):
        out += _bar(kind, far + 8 + 14 * number, far + 70, side_mm, words, CLOSE_AXIS - 40 + 40 * number)
    return out + _figures(budget, far + 70)


def _side_label(side: Side) -> str:
    return f"{side.sensor_mm:.2f} mm, keeps {side.captured:.2f} of the field's edge"


def _bar(kind: str, x: float, words_x: float, size_mm: float, words: str, y: float) -> list[str]:
    """Return a bar of length `size_mm` at `x` px beside the sensor, with its label and a leader line."""
    half = CLOSE * size_mm / 2
    bar = f'<path class="ray" style="stroke-width:5" d="M {x:.1f} {CLOSE_AXIS - half:.1f} V {CLOSE_AXIS + half:.1f}"/>'
    lead = line(x + 3, min(max(y, CLOSE_AXIS - half), CLOSE_AXIS + half), words_x - 4, y - 4, "lead")
    return [lead, f'<g class="{kind}">{bar}</g>', text(words_x, y, words, "small")]


def _figures(budget: OpticalBudget, x: float) -> list[str]:
    """Return the figures that the drawing does not show, as text at the right."""
    facts = (
        f"field {budget.field_deg:g} deg: {budget.retina_mm:.1f} mm of the retina",
        f"{budget.px_per_deg:.1f} px/deg, {budget.retina_um_per_px:.1f} um of the retina a pixel",
        f"iris at the pupil {budget.iris_at_eye_mm:.2f} mm, margin at the iris {budget.pupil_margin_mm:.2f} mm",
        f"ring at the pupil {budget.ring_at_pupil_mm:.2f} mm, {budget.leds} LEDs, cone {budget.led_cone_deg:.1f} deg",
        f"expected half-period {budget.half_period_um:.0f} um by {budget.electrons_per_px:.0f} electrons a pixel",
        "thin lenses; the two crossed polarisers are not drawn",
    )
    return [text(x + 350, CLOSE_AXIS - 100 + 22 * row, words, "small") for row, words in enumerate(facts)]
