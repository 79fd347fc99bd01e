"""Procedural fundus: vessels, optic disc, macula, choroid and lesions, drawn from a seed.

    fundus      draws the retina, colour by colour, as reflectance
    Fundus      its result: reflectances, vessels, field, places of disc and fovea

Coordinates are degrees right and down from the fovea of a right eye; the left eye is its mirror image. Colours follow
OPTICS.md 4.1. The disc is the optic disc.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import expit

from device.sim.lesions import Lesions, scatter
from device.sim.pigments import AT_FOVEA, Pigments
from device.sim.strokes import draw
from device.sim.vessels import DISC, Vessel, grow
from device.values import Colour, Eye, Image, Mask

FIELD_CENTRE_DEG = (5.2, -0.4)  # centre of the picture, in degrees from the fovea: between macula and disc
LEVEL: dict[Colour, float] = {"red": 0.049, "green": 0.0141, "blue": 0.0081}  # Delori & Pflibsen 1989, perifovea
BLOOD: dict[Colour, float] = {"red": 0.08, "green": 0.55, "blue": 0.45}  # contrast of the widest vein
ARTERY = 0.70  # contrast of arteries relative to veins: oxygenated blood is brighter
MACULA: dict[Colour, float] = {"red": 0.16, "green": 0.30, "blue": 0.45}
DISC_GAIN: dict[Colour, float] = {"red": 1.45, "green": 2.1, "blue": 2.6}
EXUDATE: dict[Colour, float] = {"red": 0.25, "green": 0.6, "blue": 0.35}
CUP: dict[Colour, float] = {"red": 0.08, "green": 0.26, "blue": 0.34}
CHOROID: dict[Colour, float] = {"red": 0.10, "green": 0.05, "blue": 0.02}
COLOURS: tuple[Colour, ...] = ("red", "green", "blue")
MEAN_EYE = Pigments()


@dataclass(frozen=True)
class Fundus:
    """Retina as an object: reflectance per colour, float32 (rows, cols), zero outside the round field.

    `vessels` (None: not known) and `field` are masks; `disc` and `fovea` are (row, col), None where not known.
    """

    reflectance: dict[Colour, Image]
    field: Mask
    vessels: Mask | None = None
    disc: tuple[float, float] | None = None
    fovea: tuple[float, float] | None = None

    def plane(self, colour: Colour) -> Image:
        """Return the reflectance in one colour; in amber the geometric mean of red and green where it was not drawn."""
        if colour == "amber" and colour not in self.reflectance:
            mixed: Image = np.sqrt(self.reflectance["red"] * self.reflectance["green"])
            return mixed
        return self.reflectance[colour]


@dataclass(frozen=True)
class Canvas:
    """Pixel grid of a drawing: `x` (1, cols) and `y` (rows, 1) are degrees right and down from the fovea.

    `margin_px` pixels on each side are beyond the field; the drawing inside does not depend on them.
    """

    shape: tuple[int, int]
    px_per_deg: float
    x: Image = field(repr=False)
    y: Image = field(repr=False)
    margin_px: int = 0

    @classmethod
    def of(cls, inner: tuple[int, int], px_per_deg: float, margin_px: int = 0) -> "Canvas":
        """Return a canvas of `inner` (rows, cols) and a margin, centred on FIELD_CENTRE_DEG."""
        shape = (inner[0] + 2 * margin_px, inner[1] + 2 * margin_px)
        down, right = (((np.arange(n) - (n - 1) / 2) / px_per_deg).astype(np.float32) for n in shape)
        x = (right + FIELD_CENTRE_DEG[0])[None, :]
        y = (down + FIELD_CENTRE_DEG[1])[:, None]
        return cls(shape, px_per_deg, x, y, margin_px)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return the (row, col) of a place (x, y) in degrees from the fovea."""
        row, col = ((n - 1) / 2 for n in self.shape)
        return row + (y - FIELD_CENTRE_DEG[1]) * self.px_per_deg, col + (x - FIELD_CENTRE_DEG[0]) * self.px_per_deg

    def distance(self, x: float, y: float) -> Image:
        """Return the distance of every pixel from a place (x, y), degrees, (rows, cols)."""
        away: Image = np.hypot(self.x - np.float32(x), self.y - np.float32(y))
        return away

    def noise(self, rng: np.random.Generator, scale_deg: float) -> Image:
        """Return noise of zero mean and unit variance, smoothed by a Gaussian of sigma `scale_deg`.

        In the margin it is mirrored.
        """
        inner = (self.shape[0] - 2 * self.margin_px, self.shape[1] - 2 * self.margin_px)
        raw = rng.standard_normal(inner, dtype=np.float32)
        return np.pad(smooth(raw, scale_deg * self.px_per_deg), self.margin_px, mode="symmetric")


def smooth(raw: Image, sigma_px: float) -> Image:
    """Return noise smoothed by a Gaussian, zero mean, unit variance; a wide Gaussian uses a small part, enlarged."""
    shrink = max(1, int(sigma_px / 3))
    few = raw[: -(-raw.shape[0] // shrink) + 3, : -(-raw.shape[1] // shrink) + 3]
    soft = ndimage.gaussian_filter(few, sigma_px / shrink, mode="wrap")
    if shrink > 1:
        soft = ndimage.zoom(soft, shrink, order=1)[: raw.shape[0], : raw.shape[1]]
    grown: Image = (soft - soft.mean()) / max(float(soft.std()), 1e-9)
    return grown


def field_mask(shape: tuple[int, int], radius_px: float) -> Mask:
    """Return the mask of the round field in the middle of `shape` (rows, cols)."""
    return _radius(shape) <= radius_px


def fundus(
    shape: tuple[int, int],
    px_per_deg: float,
    field_deg: float,
    seed: int,
    *,
    eye: Eye = "OD",
    haemorrhages: int = 0,
    microaneurysms: int = 0,
    exudates: int = 0,
    beyond_deg: float = 0.0,
    pigments: Pigments = MEAN_EYE,
) -> Fundus:
    """Return one retina drawn in the middle of `shape` (rows, cols), reproducible by its arguments.

    The field is a disc of radius px_per_deg * field_deg / 2 (small angle, as in values.Geometry), cropped to `shape`.
    For an eye that turns, the retina is continued `beyond_deg` beyond this disc, which stays the same but for the ends
    of vessels at its edge; lesions are inside it. Reflectances are fractions of the light, about 0.01 in green.
    """
    wide = int(np.ceil(px_per_deg * field_deg)) + 2
    inner = (wide + (wide - shape[0]) % 2, wide + (wide - shape[1]) % 2)  # centres of canvas and shape coincide
    canvas = Canvas.of(inner, px_per_deg, int(np.ceil(px_per_deg * beyond_deg)))
    size = canvas.shape
    radius_px = px_per_deg * (field_deg / 2 + beyond_deg)
    rng = np.random.default_rng((seed, 2))
    vessels = grow(seed, field_deg / 2 + 1, FIELD_CENTRE_DEG, beyond_deg)
    lesion_rng = np.random.default_rng((seed, 3))  # separate stream: lesions leave the rest of the picture unchanged
    lesions = scatter(
        canvas.x, canvas.y, lesion_rng, field_deg / 2, FIELD_CENTRE_DEG, haemorrhages, microaneurysms, exudates
    )
    planes, mask = _paint(canvas, vessels, lesions, rng, pigments)
    edge = np.clip(radius_px + 0.5 - _radius(size), 0, 1)
    for colour in COLOURS:
        planes[colour] = _placed(planes[colour] * edge, shape, eye)
    field_px = field_mask(shape, radius_px)
    where = [_moved(canvas.at(*place), size, shape, eye) for place in (DISC, (0.0, 0.0))]
    return Fundus(planes, field_px, _placed(mask, shape, eye) & field_px, where[0], where[1])


def _paint(
    canvas: Canvas, vessels: list[Vessel], lesions: Lesions, rng: np.random.Generator, pigments: Pigments
) -> tuple[dict[Colour, Image], Mask]:
    """Return the reflectances on the canvas, not yet cropped by the round field, and the mask of the vessels."""
    veins = draw([v for v in vessels if v.kind == "vein"], canvas.shape, canvas.px_per_deg, canvas.at)
    arteries = draw([v for v in vessels if v.kind == "artery"], canvas.shape, canvas.px_per_deg, canvas.at, reflex=0.4)
    ground = _ground(canvas, rng, pigments)
    disc, cup = _disc(canvas, rng)
    planes: dict[Colour, Image] = {}
    for colour in COLOURS:
        tissue = ground[colour] * (1 + (DISC_GAIN[colour] - 1) * disc) * (1 + CUP[colour] * cup)
        tissue *= 1 + EXUDATE[colour] * lesions.bright * (1 - disc)
        blood = pigments.blood(BLOOD[colour]) * (1 - 0.25 * disc)
        through = (1 - blood * veins.blood) * (1 - ARTERY * blood * arteries.blood) * (1 - blood * lesions.dark)
        planes[colour] = np.float32(pigments.reflectance(colour, LEVEL[colour])) * tissue * through
    return planes, veins.mask | arteries.mask


def _ground(canvas: Canvas, rng: np.random.Generator, pigments: Pigments) -> dict[Colour, Image]:
    """Return the relative brightness of the tissue per colour, about 1, without retinal vessels and optic disc."""
    fovea = canvas.distance(0, 0)
    shade = 1 + 0.04 * canvas.noise(rng, 4.5) - 0.0006 * canvas.distance(*FIELD_CENTRE_DEG) ** 2
    web = _choroid(canvas, rng)
    grain = 0.5 * canvas.noise(rng, 0.07) + 0.5 * canvas.noise(rng, 0.25)
    nerve = 0.16 * np.exp(-((canvas.distance(DISC[0] - 0.5, DISC[1]) / 5.5) ** 2))
    planes: dict[Colour, Image] = {}
    for colour in COLOURS:
        depth = pigments.macula(colour, MACULA[colour])
        choroid = pigments.choroid(colour, CHOROID[colour])
        macula = 1 - depth * np.exp(-((fovea / 2.7) ** 2)) - (AT_FOVEA - 1) * depth * np.exp(-((fovea / 0.8) ** 2))
        fibres = 1 + (0.3 if colour == "red" else 1.0) * nerve
        planes[colour] = shade * macula * fibres * (1 + choroid * web + 0.018 * grain)
    return planes


def _choroid(canvas: Canvas, rng: np.random.Generator) -> Image:
    """Return the pattern of the choroidal vessels, about -0.7 to 0.9: ridges of smooth noise, weaker at the macula."""
    ridges = (
        np.exp(-((canvas.noise(rng, 0.8) / 0.55) ** 2)) + 0.6 * np.exp(-((canvas.noise(rng, 0.45) / 0.5) ** 2)) - 0.7
    )
    web: Image = ridges * (1 - 0.7 * np.exp(-((canvas.distance(0, 0) / 4.5) ** 2)))
    return web


def _disc(canvas: Canvas, rng: np.random.Generator) -> tuple[Image, Image]:
    """Return the shares of optic disc and cup per pixel, 0 to 1; the rim is paler on the temporal side."""
    x = canvas.x - np.float32(DISC[0])
    y = canvas.y - np.float32(DISC[1])
    angle = np.arctan2(y, x)
    wobble = 1 + 0.025 * np.cos(2 * angle + rng.uniform(0, 6)) + 0.015 * np.cos(3 * angle + rng.uniform(0, 6))
    radius = np.hypot(x / np.float32(2.65), y / np.float32(2.95)) * wobble
    soft = 0.05 + 0.02 * np.cos(angle)
    disc = expit((1 - radius) / soft)
    disc *= 0.80 - 0.14 * np.clip(x / np.float32(2.65), -1, 1)
    cup_size = rng.uniform(0.34, 0.48)
    cup = expit((cup_size - np.hypot((x + 0.25) / 2.65, y / 2.95)) / 0.06)
    return disc.astype(np.float32), cup.astype(np.float32)


def _radius(shape: tuple[int, int]) -> Image:
    """Return the distance of every pixel from the centre, px."""
    rows, cols = (np.arange(size, dtype=np.float32) - np.float32((size - 1) / 2) for size in shape)
    radius: Image = np.hypot(rows[:, None], cols[None, :])
    return radius


def _placed(plane: NDArray[Any], shape: tuple[int, int], eye: Eye) -> NDArray[Any]:
    """Return the plane centred in an array of `shape`, cropped or zero-padded, mirrored for a left eye."""
    out = np.zeros(shape, plane.dtype)
    rows, cols = (_overlap(*sizes) for sizes in zip(plane.shape, shape, strict=True))
    out[rows[1], cols[1]] = (plane if eye == "OD" else plane[:, ::-1])[rows[0], cols[0]]
    return out


def _overlap(size: int, wanted: int) -> tuple[slice, slice]:
    """Return the overlap of two ranges with one centre, of `size` and `wanted` pixels, as a slice of each."""
    first = (wanted - size) // 2
    kept = min(size, wanted)
    return slice(max(-first, 0), max(-first, 0) + kept), slice(max(first, 0), max(first, 0) + kept)


def _moved(place: tuple[float, float], size: tuple[int, int], shape: tuple[int, int], eye: Eye) -> tuple[float, float]:
    """Return the (row, col) on `shape` of a (row, col) on the canvas of `size`, mirrored for a left eye."""
    row, col = (p + (wanted - n) // 2 for p, n, wanted in zip(place, size, shape, strict=True))
    return row, col if eye == "OD" else shape[1] - 1 - col
