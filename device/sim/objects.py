"""What a scene looks at, drawn as an object: retina or photograph, or a drawing on the screen behind the eye's lens.

    drawn    the object of a scene, colour by colour, with the field that cuts it

A drawing is measured in um on its surface. A place h off the axis is seen at atan(h / f) (optics.md 1.2: that makes the
paper's 15 mm 33.4 degrees), and degrees become pixels evenly (values.Geometry). Drawings are white on black, their
edges shared between pixels by area.
"""

from collections.abc import Callable
from math import atan, ceil, degrees, floor, hypot

import numpy as np
from scipy import ndimage

from device.errors import SpecError
from device.scene import ObjectSpec, SimSpec
from device.sim.fundus import COLOURS, Fundus, field_mask, fundus
from device.sim.photo import photograph
from device.spec import OpticsSpec
from device.values import Eye, Image

Pair = tuple[float, float]
Outside = Callable[[Image, Image], Image]  # how far places (right, down, in um) are outside a drawing; inside: negative

SUBPIXELS = 3  # a pixel's share is measured at 3 x 3 of its places: a disc's light is then right to 0.05 %
STEEPEST_RAD = 1.4  # no field is wider; keeps tan() finite in the corners
TICK_UM, FIFTH_TICK_UM = 1500.0, 3000.0  # a ruler's ticks, and every fifth of them
SLACK_DEG = 0.05  # an object may end on the field's edge


def drawn(scene: SimSpec, optics: OpticsSpec, eye: Eye, shape: tuple[int, int], px_per_deg: float) -> Fundus:
    """The object of a scene in the middle of `shape` (rows, cols): reflectances in 0..1, zero outside the field.

    It is moved by the object's place and the eye's gaze together. Raises SpecError for a drawing that does not fit into
    the field, or a photograph that cannot be read.
    """
    what, gaze = scene.object, scene.eye.gaze_deg
    at_deg = (what.at_deg[0] + gaze[0], what.at_deg[1] + gaze[1])
    if what.kind in ("retina", "image"):
        return _pictured(scene, optics, eye, shape, px_per_deg, at_deg)
    _refuse_what_does_not_fit(what, scene.eye.focal_length_um, optics.field_deg, at_deg)
    outside = {"dots": _dots, "ruler": _ruler, "point": _disc}[what.kind](what)
    plane = _covered(outside, scene.eye.focal_length_um, shape, px_per_deg, at_deg)
    if what.kind == "ruler" and what.polarity == "negative":
        plane = 1 - plane
    plane *= _soft_field(shape, px_per_deg * optics.field_deg / 2)
    return Fundus(dict.fromkeys(COLOURS, plane), field_mask(shape, px_per_deg * optics.field_deg / 2))


def angle_deg(height_um: float, focal_length_um: float) -> float:
    """At which angle from the axis a place on the screen is seen."""
    return degrees(atan(height_um / focal_length_um))


def height_um(angle_off_deg: float, focal_length_um: float) -> float:
    """How far from the axis a place on the screen is that is seen at this angle."""
    return float(focal_length_um * np.tan(np.radians(angle_off_deg)))


def _pictured(
    scene: SimSpec, optics: OpticsSpec, eye: Eye, shape: tuple[int, int], px_per_deg: float, at_deg: Pair
) -> Fundus:
    """A retina or a photograph of one, moved behind the field, which stays."""
    what = scene.object
    if at_deg == (0.0, 0.0) and what.size_deg is None:
        return _picture(scene, eye, shape, px_per_deg, optics.field_deg)
    wide_deg = what.size_deg or optics.field_deg + (2 * hypot(*at_deg) if what.kind == "retina" else 0.0)
    wide = ceil(px_per_deg * max(wide_deg, optics.field_deg)) + 4
    rows, cols = (max(wide + (wide - n) % 2, n) for n in shape)
    found = _picture(scene, eye, (rows, cols), px_per_deg, wide_deg)
    return _behind(found, shape, px_per_deg * optics.field_deg / 2, (at_deg[1] * px_per_deg, at_deg[0] * px_per_deg))


def _picture(scene: SimSpec, eye: Eye, shape: tuple[int, int], px_per_deg: float, wide_deg: float) -> Fundus:
    what = scene.object
    if what.image is not None:
        return photograph(what.image, shape, px_per_deg, wide_deg)
    return fundus(
        shape, px_per_deg, wide_deg, scene.seed % 2**32, eye=eye, haemorrhages=what.haemorrhages,
        microaneurysms=what.microaneurysms, exudates=what.exudates,
    )  # fmt: skip


def _behind(found: Fundus, shape: tuple[int, int], radius_px: float, move_px: Pair) -> Fundus:
    """The middle of a larger picture that has been moved down and right, seen through the field's round window."""
    edge, field = _soft_field(shape, radius_px), field_mask(shape, radius_px)
    size = found.field.shape
    first = [(n - want) // 2 for n, want in zip(size, shape, strict=True)]
    window = tuple(slice(a, a + want) for a, want in zip(first, shape, strict=True))

    def seen(plane: Image) -> Image:
        moved = plane if move_px == (0.0, 0.0) else ndimage.shift(plane, move_px, order=3)
        return np.maximum(moved[window], 0)

    def place(was: Pair | None) -> Pair | None:
        return None if was is None else (was[0] - first[0] + move_px[0], was[1] - first[1] + move_px[1])

    planes = {colour: (seen(plane) * edge).astype(np.float32) for colour, plane in found.reflectance.items()}
    vessels = None if found.vessels is None else (seen(found.vessels.astype(np.float32)) > 0.5) & field
    return Fundus(planes, field, vessels, place(found.disc), place(found.fovea))


def _soft_field(shape: tuple[int, int], radius_px: float) -> Image:
    """The round field with an edge of one pixel."""
    rows, cols = (np.arange(n, dtype=np.float32) - np.float32((n - 1) / 2) for n in shape)
    soft: Image = np.clip(radius_px + 0.5 - np.hypot(rows[:, None], cols[None, :]), 0, 1, dtype=np.float32)
    return soft


def _covered(
    outside: Outside, focal_length_um: float, shape: tuple[int, int], px_per_deg: float, at_deg: Pair
) -> Image:
    """Which share of each pixel a drawing covers, float32 (rows, cols)."""
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
    """Where directions meet the flat surface behind the lens: f tan(theta) from the axis, at the same azimuth."""
    angle = np.radians(np.hypot(right_deg, down_deg))
    stretch = np.float32(focal_length_um) * np.tan(np.minimum(angle, STEEPEST_RAD))
    per_deg = np.where(angle > 0, stretch / np.maximum(np.degrees(angle), 1e-12), np.radians(focal_length_um))
    return np.asarray(right_deg * per_deg, np.float32), np.asarray(down_deg * per_deg, np.float32)


def _disc(what: ObjectSpec) -> Outside:
    return lambda x, y: np.hypot(x, y) - np.float32(what.dot_um / 2)


def _dots(what: ObjectSpec) -> Outside:
    """A lattice of discs with one in its middle."""
    apart = np.float32(what.dots_apart_um)
    right, down = (floor(half / what.dots_apart_um + 1e-6) for half in what.half_size_um)

    def outside(x: Image, y: Image) -> Image:
        x = x - apart * np.clip(np.rint(x / apart), -right, right)
        y = y - apart * np.clip(np.rint(y / apart), -down, down)
        return _disc(what)(x, y)

    return outside


def _ruler(what: ObjectSpec) -> Outside:
    """A line as long as the ruler, and ticks standing on it; the outermost ticks' middles are its ends."""
    half, stroke, apart = (np.float32(v) for v in (what.length_um / 2, what.stroke_um / 2, what.ticks_um))
    most = floor(what.length_um / 2 / what.ticks_um + 1e-6)

    def outside(x: Image, y: Image) -> Image:
        number = np.clip(np.rint(x / apart), -most, most)
        tall = np.where(number % 5 == 0, np.float32(FIFTH_TICK_UM), np.float32(TICK_UM))
        tick = np.maximum(np.abs(x - number * apart) - stroke, np.maximum(-y - tall, y))
        line = np.maximum(np.abs(y) - stroke, np.abs(x) - half)
        return np.asarray(np.minimum(tick, line))

    return outside


def _refuse_what_does_not_fit(what: ObjectSpec, focal_length_um: float, field_deg: float, at_deg: Pair) -> None:
    """A drawing that the field cuts off would be judged by what nobody can see."""
    lattice = [floor(half / what.dots_apart_um + 1e-6) * what.dots_apart_um for half in what.half_size_um]
    key, said, right_um, down_um, rim_um = {
        "dots": ("half_size_um", what.half_size_um, lattice[0], lattice[1], what.dot_um / 2),
        "ruler": ("length_um", what.length_um, what.length_um / 2, 0.0, 0.0),
        "point": ("dot_um", what.dot_um, 0.0, 0.0, what.dot_um / 2),
    }[what.kind]
    x_um, y_um = (abs(float(v)) for v in _on_screen(np.float32(at_deg[0]), np.float32(at_deg[1]), focal_length_um))
    reach_um, ends_um = hypot(x_um + right_um, y_um + down_um) + rim_um, height_um(field_deg / 2, focal_length_um)
    reach_deg = angle_deg(reach_um, focal_length_um)
    if reach_deg > field_deg / 2 + SLACK_DEG:
        raise SpecError(
            f"sim.object.{key} = {said} at {hypot(*at_deg):g} deg reaches {reach_deg:.1f} deg "
            f"from the axis; the field of optics.field_deg = {field_deg:g} ends at {field_deg / 2:g}",
            f"Keep all of it within 0 to {ends_um:.0f} um of the axis, move it inwards, or widen optics.field_deg.",
        )
