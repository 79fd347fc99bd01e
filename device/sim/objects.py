"""Objects of a scene: retina, photograph, or a drawing on the screen behind the eye's lens.

    draw_object    the object of a scene, colour by colour, cropped by the field

A drawing is measured in um on its surface. A place h off the axis appears at atan(h / f) (OPTICS.md 1.2: then the
paper's 15 mm are 33.4 degrees), and degrees map linearly to pixels (values.Geometry). Drawings are white on black,
but for the retina chart; pixels on an edge have the value of their covered area.
"""

from collections.abc import Callable
from functools import partial
from math import atan, ceil, degrees, floor, hypot
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.config.head_file import OpticsSpec
from device.config.scene import ObjectSpec, SimSpec
from device.errors import SpecError
from device.optics import retina_chart
from device.sim.fundus import COLOURS, Fundus, field_mask, fundus
from device.sim.photo import photograph
from device.sim.pigments import Pigments
from device.values import Eye, Image

Pair = tuple[float, float]
SignedDistance = Callable[
    [Image, Image], Image
]  # signed distance of (right, down) in um to a drawing; inside: negative

Floats = NDArray[np.float64]

SUBPIXELS = 3  # 3 x 3 samples per pixel for its covered area: the error of a disc's light is then 0.05 %
MAX_ANGLE_RAD = 1.4  # no field is wider; keeps tan() finite in the corners
TICK_UM, FIFTH_TICK_UM = 1500.0, 3000.0  # heights of a ruler's ticks and of every fifth tick
SMALLEST_SINE = 1e-12  # keeps the quotient of angle and sine finite on the axis
TOLERANCE_DEG = 0.05  # tolerance for an object that ends on the field's edge


def draw_object(
    scene: SimSpec,
    optics: OpticsSpec,
    eye: Eye,
    shape: tuple[int, int],
    px_per_deg: float,
    turn_deg: Pair = (0.0, 0.0),
    lit_deg: float | None = None,
) -> Fundus:
    """Return the object of a scene in the middle of `shape` (rows, cols): reflectances in 0..1, zero outside the light.

    `lit_deg` is the full angle to which light arrives, at least that of the field; None: the field has a sharp edge.

    The object is shifted by `at_deg` of the scene plus the eye's gaze and `turn_deg`; a retina is shifted by `at_deg`
    and turns with the eye as a sphere (OPTICS.md 3.9). SpecError for a drawing that does not fit into the field, or a
    photograph that cannot be read.
    """
    what = scene.object
    gaze = scene.eye.gaze_deg
    lit_deg = lit_deg or optics.field_deg
    gaze_deg = (gaze[0] + turn_deg[0], gaze[1] + turn_deg[1])
    at_deg = (what.at_deg[0] + gaze_deg[0], what.at_deg[1] + gaze_deg[1])
    if what.kind in ("retina", "image"):
        found = _moved_picture(scene, optics, eye, shape, px_per_deg, gaze_deg, lit_deg)
        return found if what.cut_deg is None else _cut(found, what.cut_deg, px_per_deg)
    if what.kind == "chart":
        return _chart(scene.eye.focal_length_um, lit_deg, shape, px_per_deg, at_deg)
    _refuse_drawing_beyond_field(what, scene.eye.focal_length_um, optics.field_deg, at_deg)
    outside = {"dots": _dots, "ruler": _ruler, "point": _disc}[what.kind](what)
    plane = _coverage(outside, scene.eye.focal_length_um, shape, px_per_deg, at_deg)
    if what.kind == "ruler" and what.polarity == "negative":
        plane = 1 - plane
    plane *= _soft_field(shape, px_per_deg * lit_deg / 2)
    return Fundus(dict.fromkeys(COLOURS, plane), field_mask(shape, px_per_deg * lit_deg / 2))


def _chart(focal_length_um: float, field_deg: float, shape: tuple[int, int], px_per_deg: float, at_deg: Pair) -> Fundus:
    """Return the retina chart of the model eye on white paper, cropped by the field."""
    plane = np.ones(shape, np.float32)
    for tone in (retina_chart.INK, retina_chart.GREY):
        outside = partial(retina_chart.signed_distance_um, retina_chart.of_tone(tone))
        plane -= np.float32(1 - tone) * _coverage(outside, focal_length_um, shape, px_per_deg, at_deg)
    radius_px = px_per_deg * field_deg / 2
    plane *= _soft_field(shape, radius_px)
    return Fundus(dict.fromkeys(COLOURS, plane), field_mask(shape, radius_px))


def angle_deg(height_um: float, focal_length_um: float) -> float:
    """Return the angle from the axis of a place on the screen, degrees."""
    return degrees(atan(height_um / focal_length_um))


def height_um(angle_off_deg: float, focal_length_um: float) -> float:
    """Return the distance from the axis of the place on the screen that appears at this angle, um."""
    return float(focal_length_um * np.tan(np.radians(angle_off_deg)))


def _moved_picture(
    scene: SimSpec,
    optics: OpticsSpec,
    eye: Eye,
    shape: tuple[int, int],
    px_per_deg: float,
    gaze_deg: Pair,
    lit_deg: float,
) -> Fundus:
    """Return a retina or photograph, shifted and turned (right, down), cropped by the light, which stays centred."""
    what = scene.object
    is_retina = scene.object.kind == "retina"
    more_deg = (lit_deg - optics.field_deg) / 2
    if what.at_deg == gaze_deg == (0.0, 0.0) and what.size_deg is None:
        return _picture(scene, eye, shape, px_per_deg, optics.field_deg, more_deg)
    turn_deg = gaze_deg if is_retina else (0.0, 0.0)
    at_deg = what.at_deg if is_retina else (what.at_deg[0] + gaze_deg[0], what.at_deg[1] + gaze_deg[1])
    wide_deg = what.size_deg or optics.field_deg
    beyond_deg = 0.0
    if is_retina:
        beyond_deg = more_deg + hypot(*at_deg) + hypot(*turn_deg)
    wide = ceil(px_per_deg * (max(wide_deg, optics.field_deg) + 2 * max(beyond_deg, more_deg))) + 4
    rows, cols = (max(wide + (wide - n) % 2, n) for n in shape)
    found = _picture(scene, eye, (rows, cols), px_per_deg, wide_deg, beyond_deg)
    move_px, turn_px = ((offset_deg[1] * px_per_deg, offset_deg[0] * px_per_deg) for offset_deg in (at_deg, turn_deg))
    return _crop_to_field(found, shape, px_per_deg, lit_deg / 2, move_px, turn_px)


def moved_behind_field(found: Fundus, move_px: Pair, radius_px: float, turn_deg: float = 0.0) -> Fundus:
    """Return an object moved by `move_px` (down, right) behind a round field that stands still.

    Before, it is turned by `turn_deg` about the middle, counter-clockwise as displayed. What comes in from beyond the
    field repeats the nearest pixels at its edge.
    """
    edge = _soft_field(found.field.shape, radius_px)
    nearest = ndimage.distance_transform_edt(edge < 1, return_distances=False, return_indices=True)

    middle = (np.array(found.field.shape) - 1) / 2
    back = _rotation(-turn_deg)

    def shifted(plane: Image, order: Literal[1, 3], mode: Literal["nearest", "constant"]) -> Image:
        if turn_deg == 0:
            return np.asarray(ndimage.shift(plane, move_px, order=order, mode=mode))
        offset = middle - back @ (middle + np.array(move_px))
        return np.asarray(ndimage.affine_transform(plane, back, offset, order=order, mode=mode))

    def moved(plane: Image) -> Image:
        return np.asarray(np.maximum(shifted(plane[tuple(nearest)], 3, "nearest"), 0) * edge, np.float32)

    def place(position: Pair | None) -> Pair | None:
        if position is None:
            return None
        row, col = back.T @ (np.array(position) - middle) + middle + np.array(move_px)
        return float(row), float(col)

    vessels = found.vessels
    if vessels is not None:
        vessels = (shifted(vessels.astype(np.float32), 1, "constant") > 0.5) & found.field
    planes = {colour: moved(plane) for colour, plane in found.reflectance.items()}
    return Fundus(planes, found.field, vessels, place(found.disc), place(found.fovea))


def _rotation(turn_deg: float) -> NDArray[np.float64]:
    """Return the matrix of a counter-clockwise turn as displayed, for (row, col)."""
    turn = np.radians(turn_deg)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def _picture(
    scene: SimSpec, eye: Eye, shape: tuple[int, int], px_per_deg: float, wide_deg: float, beyond_deg: float = 0.0
) -> Fundus:
    """Return a photograph if the scene names one, else a retina drawn from its seed; both are `wide_deg` wide.

    The retina continues `beyond_deg` on each side.
    """
    what = scene.object
    if what.image is not None:
        return photograph(what.image, shape, px_per_deg, wide_deg, None if what.cut_deg is None else what.cut_deg[0])
    return fundus(
        shape,
        px_per_deg,
        wide_deg,
        scene.seed % 2**32,
        eye=eye,
        haemorrhages=what.haemorrhages,
        microaneurysms=what.microaneurysms,
        exudates=what.exudates,
        beyond_deg=beyond_deg,
        pigments=Pigments(what.melanin, what.macular_pigment, what.haemoglobin),
    )


def _crop_to_field(
    found: Fundus, shape: tuple[int, int], px_per_deg: float, half_field_deg: float, move_px: Pair, turn_px: Pair
) -> Fundus:
    """Return the middle of a larger picture, shifted, turned (down, right) and cropped to the round field."""
    radius_px = px_per_deg * half_field_deg
    edge = _soft_field(shape, radius_px)
    field = field_mask(shape, radius_px)
    size = found.field.shape
    first = [(n - want) // 2 for n, want in zip(size, shape, strict=True)]
    window = tuple(slice(a, a + want) for a, want in zip(first, shape, strict=True))
    middle = (np.array(shape) - 1) / 2
    if turn_px != (0.0, 0.0):
        seen = turned_places(np.indices(shape) - middle[:, None, None], turn_px, px_per_deg, back=True)
        at = seen + (np.array(size) - 1)[:, None, None] / 2 - np.array(move_px)[:, None, None]

    def moved(plane: Image) -> Image:
        if turn_px != (0.0, 0.0):
            return np.maximum(ndimage.map_coordinates(plane, at, order=3), 0)
        shifted = plane if move_px == (0.0, 0.0) else ndimage.shift(plane, move_px, order=3)
        return np.maximum(shifted[window], 0)

    def place(position: Pair | None) -> Pair | None:
        if position is None:
            return None
        there = np.array(position) - (np.array(size) - 1) / 2 + np.array(move_px)
        row, col = turned_places(there, turn_px, px_per_deg) + middle
        return float(row), float(col)

    planes = {colour: (moved(plane) * edge).astype(np.float32) for colour, plane in found.reflectance.items()}
    vessels = None if found.vessels is None else (moved(found.vessels.astype(np.float32)) > 0.5) & field
    return Fundus(planes, field, vessels, place(found.disc), place(found.fovea))


def turned_places(places: Floats, turn_px: Pair, px_per_deg: float, *, back: bool = False) -> Floats:
    """Return where places (2, ...) from the centre stand after the eye has turned the centre to `turn_px`.

    Rows and cols in pixels. The directions of the retina turn as a rigid body about the axis across the turn; `back`
    inverts it. OPTICS.md 3.9.
    """
    length_px = hypot(*turn_px)
    if length_px == 0:
        return places
    down = turn_px[0] / length_px
    right = turn_px[1] / length_px
    by = np.radians(length_px / px_per_deg) * (-1 if back else 1)
    away_px = np.hypot(places[0], places[1])
    angle = np.radians(away_px / px_per_deg)
    shrunk = np.sinc(angle / np.pi) * np.radians(1 / px_per_deg)
    along = shrunk * (down * places[0] + right * places[1])
    across = shrunk * (down * places[1] - right * places[0])
    along, axial = np.cos(by) * along + np.sin(by) * np.cos(angle), np.cos(by) * np.cos(angle) - np.sin(by) * along
    sine = np.hypot(along, across)
    stretch = px_per_deg * np.degrees(np.arctan2(sine, axial)) / np.maximum(sine, SMALLEST_SINE)
    return np.stack([stretch * (down * along - right * across), stretch * (right * along + down * across)])


def _cut(found: Fundus, cut_deg: Pair, px_per_deg: float) -> Fundus:
    """Return an object cut to a centred rectangle (right, down) with an edge of one pixel."""
    sides = [
        np.clip(px_per_deg * side / 2 + 0.5 - np.abs(np.arange(n) - (n - 1) / 2), 0, 1).astype(np.float32)
        for n, side in zip(found.field.shape, reversed(cut_deg), strict=True)
    ]
    window = sides[0][:, None] * sides[1][None, :]
    kept = found.field & (window > 0.5)
    planes = {colour: plane * window for colour, plane in found.reflectance.items()}
    return Fundus(planes, kept, None if found.vessels is None else found.vessels & kept, found.disc, found.fovea)


def _soft_field(shape: tuple[int, int], radius_px: float) -> Image:
    """Return the round field with an edge of one pixel, 0 to 1."""
    rows, cols = (np.arange(n, dtype=np.float32) - np.float32((n - 1) / 2) for n in shape)
    soft: Image = np.clip(radius_px + 0.5 - np.hypot(rows[:, None], cols[None, :]), 0, 1, dtype=np.float32)
    return soft


def _coverage(
    outside: SignedDistance, focal_length_um: float, shape: tuple[int, int], px_per_deg: float, at_deg: Pair
) -> Image:
    """Return the share of each pixel that a drawing moved to `at_deg` covers, 0 to 1, float32 (rows, cols)."""
    fine_um = np.float32(focal_length_um * np.radians(1 / px_per_deg) / SUBPIXELS)
    middle = _on_screen(np.float32(at_deg[0]), np.float32(at_deg[1]), focal_length_um)
    total = np.zeros(shape, np.float32)
    parts = (np.arange(SUBPIXELS) - (SUBPIXELS - 1) / 2) / SUBPIXELS
    for down in parts:
        for right in parts:
            y, x = (
                ((np.arange(n) - (n - 1) / 2 + part) / px_per_deg).astype(np.float32)
                for n, part in zip(shape, (down, right), strict=True)
            )
            x_um, y_um = _on_screen(x[None, :], y[:, None], focal_length_um)
            total += np.clip(0.5 - outside(x_um - middle[0], y_um - middle[1]) / fine_um, 0, 1)
    total /= SUBPIXELS**2
    return total


def _on_screen(
    right_deg: Image | np.float32, down_deg: Image | np.float32, focal_length_um: float
) -> tuple[Image, Image]:
    """Return (right, down), um, of directions on the flat surface behind the lens: f tan(theta), same azimuth."""
    angle = np.radians(np.hypot(right_deg, down_deg))
    stretch = np.float32(focal_length_um) * np.tan(np.minimum(angle, MAX_ANGLE_RAD))
    per_deg = np.where(angle > 0, stretch / np.maximum(np.degrees(angle), 1e-12), np.radians(focal_length_um))
    return np.asarray(right_deg * per_deg, np.float32), np.asarray(down_deg * per_deg, np.float32)


def _disc(what: ObjectSpec) -> SignedDistance:
    """Return the function of the signed distance to a centred disc of diameter `dot_um`."""
    return lambda x, y: np.hypot(x, y) - np.float32(what.dot_um / 2)


def _dots(what: ObjectSpec) -> SignedDistance:
    """Return the function of the signed distance to a lattice of discs within `half_size_um`, one in the middle."""
    apart = np.float32(what.dots_apart_um)
    right, down = (floor(half / what.dots_apart_um + 1e-6) for half in what.half_size_um)

    def outside(x: Image, y: Image) -> Image:
        x = x - apart * np.clip(np.rint(x / apart), -right, right)
        y = y - apart * np.clip(np.rint(y / apart), -down, down)
        return _disc(what)(x, y)

    return outside


def _ruler(what: ObjectSpec) -> SignedDistance:
    """Return the function of the signed distance to a ruler: a horizontal line with upward ticks, one in its middle."""
    half, stroke, apart = (np.float32(v) for v in (what.length_um / 2, what.stroke_um / 2, what.ticks_um))
    most = floor(what.length_um / 2 / what.ticks_um + 1e-6)

    def outside(x: Image, y: Image) -> Image:
        number = np.clip(np.rint(x / apart), -most, most)
        tall = np.where(number % 5 == 0, np.float32(FIFTH_TICK_UM), np.float32(TICK_UM))
        tick = np.maximum(np.abs(x - number * apart) - stroke, np.maximum(-y - tall, y))
        line = np.maximum(np.abs(y) - stroke, np.abs(x) - half)
        return np.asarray(np.minimum(tick, line))

    return outside


def _refuse_drawing_beyond_field(what: ObjectSpec, focal_length_um: float, field_deg: float, at_deg: Pair) -> None:
    """Raise SpecError for a drawing that extends beyond the field by more than 0.05 degrees."""
    lattice = [floor(half / what.dots_apart_um + 1e-6) * what.dots_apart_um for half in what.half_size_um]
    key, size, right_um, down_um, rim_um = {
        "dots": ("half_size_um", what.half_size_um, lattice[0], lattice[1], what.dot_um / 2),
        "ruler": ("length_um", what.length_um, what.length_um / 2, 0.0, 0.0),
        "point": ("dot_um", what.dot_um, 0.0, 0.0, what.dot_um / 2),
    }[what.kind]
    x_um, y_um = (abs(float(v)) for v in _on_screen(np.float32(at_deg[0]), np.float32(at_deg[1]), focal_length_um))
    reach_um = hypot(x_um + right_um, y_um + down_um) + rim_um
    ends_um = height_um(field_deg / 2, focal_length_um)
    reach_deg = angle_deg(reach_um, focal_length_um)
    if reach_deg > field_deg / 2 + TOLERANCE_DEG:
        raise SpecError(
            f"sim.object.{key} = {size} at {hypot(*at_deg):g} deg reaches {reach_deg:.1f} deg "
            f"from the axis; the field of optics.field_deg = {field_deg:g} ends at {field_deg / 2:g}",
            f"Keep all of it within 0 to {ends_um:.0f} um of the axis, move it inwards, or widen optics.field_deg.",
        )
