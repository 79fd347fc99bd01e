"""Frames of a moving retina behind a field that stands still; they share no operator with the solver."""

from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.spatial.transform import Rotation

from device.recon.model.grid import disc
from device.values import Calibration, Counts, Geometry, Image, Psf, Sensor

Floats = NDArray[np.float64]

SHAPE = (360, 480)
FIELD_PX = 300
GAIN_E, READ_E, BLACK_DN = 7.3, 2.5, 64.0
DRIFT_PX = [(0.0, 0.0), (1.7, -2.4), (-3.2, 0.6), (4.1, 3.3)]


def texture(seed: int, size: int) -> Image:
    """Return a random picture with the power law of fundus photographs, mean 1, about 0.15 rms."""
    noise = np.random.default_rng(seed).normal(size=(size, size))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    picture = fft.irfft2(fft.rfft2(noise) / np.maximum(frequency, 1 / size) ** 1.3, (size, size))
    return np.asarray(np.clip(1 + 0.15 * picture / picture.std(), 0.2, 2), np.float32)


RETINA, OTHER_RETINA = texture(1, 480), texture(2, 480)


def field() -> Image:
    return disc(SHAPE, ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2), FIELD_PX / 2)


def seen(retina: Image, moved_px: tuple[float, float]) -> Image:
    """Return the retina in the field: what is at (r, c) for no movement is at (r, c) + `moved_px`."""
    moved = ndimage.shift(retina, moved_px, order=3, mode="nearest")
    top, left = (retina.shape[0] - SHAPE[0]) // 2, (retina.shape[1] - SHAPE[1]) // 2
    return np.asarray(moved[top : top + SHAPE[0], left : left + SHAPE[1]] * field(), np.float32)


def caustic() -> Image:
    """Return a PSF of bright lines, as behind a diffuser: the level lines of a smooth random surface."""
    surface = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(81, 81)), 4)
    lines = np.exp(-((surface / surface.std() / 0.12) ** 2))
    return np.asarray(lines * disc((81, 81), (40, 40), 36), np.float32)


PSF = Psf(caustic())


def frame(image: Image, peak_e: float, seed: int, psf: Psf = PSF) -> Counts:
    """Return the counts of an exposure through `psf` whose brightest pixel holds `peak_e` electrons."""
    size = [fft.next_fast_len(n + 90, real=True) for n in SHAPE]
    blurred = fft.irfft2(fft.rfft2(image, size) * fft.rfft2(psf.pixels, size), size)
    light = np.maximum(blurred[40 : 40 + SHAPE[0], 40 : 40 + SHAPE[1]], 0)
    random = np.random.default_rng(seed)
    electrons = random.poisson(light * peak_e / light.max()) + random.normal(0, READ_E, SHAPE)
    return np.clip(np.round(electrons / GAIN_E + BLACK_DN), 0, 4095).astype(np.uint16)


def burst_calibration() -> Calibration:
    """Return the calibration of these frames: PSF, levels, gain, geometry and field are known."""
    geometry = Geometry(2.4, 8000, 1.0)
    return Calibration((PSF,), Sensor(BLACK_DN, GAIN_E, READ_E, 4095.0), geometry, FIELD_PX / geometry.px_per_deg)


GAZE_SIZE, GAZE_FIELD_PX = 256, 200
WIDE_RETINA = np.asarray(ndimage.zoom(RETINA, 1.5, order=3), np.float32)
NOISE = 0.02  # of the mean: that of a reconstruction at 15,000 electrons


def gaze(retina: Image, shift_px: tuple[float, float], turn_deg: float = 0.0, seed: int = 0) -> Image:
    """Return a picture in which what is at p stands at R(p + shift), both from the centre."""
    c, s = cos(radians(turn_deg)), sin(radians(turn_deg))
    back = np.array([[c, s], [-s, c]])  # p = R^-1 q - shift
    middle, source = (GAZE_SIZE - 1) / 2, (np.array(retina.shape) - 1) / 2
    offset = source - np.array(shift_px) - back @ np.array([middle, middle])
    seen = ndimage.affine_transform(retina, back, offset, (GAZE_SIZE, GAZE_SIZE), order=3)
    seen = seen + NOISE * np.random.default_rng(seed).normal(size=seen.shape)
    return np.asarray(seen * disc((GAZE_SIZE, GAZE_SIZE), (middle, middle), GAZE_FIELD_PX / 2), np.float32)


def directions(places_px: Floats, px_per_deg: float) -> Floats:
    """Return the unit vectors (n, 3) of places (n, 2) from the centre: angle and distance are proportional."""
    angle = np.radians(np.linalg.norm(places_px, axis=1) / px_per_deg)
    azimuth = np.arctan2(places_px[:, 1], places_px[:, 0])
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1)


def places(vectors: Floats, px_per_deg: float) -> Floats:
    """Return the places (n, 2) of directions (n, 3)."""
    away_px = np.degrees(np.arccos(np.clip(vectors[:, 2], -1, 1))) * px_per_deg
    azimuth = np.arctan2(vectors[:, 1], vectors[:, 0])
    return np.stack([away_px * np.cos(azimuth), away_px * np.sin(azimuth)], axis=1)


def eye_turn(moved_px: Floats, turn_deg: float, px_per_deg: float) -> Rotation:
    """Return the rotation of an eye that takes the centre straight to `moved_px` and then turns about the axis."""
    down, right = np.radians(moved_px / px_per_deg)
    # Rows, cols and axis are right-handed: a turn by +90 degrees about it takes rows (down) to cols (right), which is
    # counter-clockwise as displayed.
    return Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)]) * Rotation.from_rotvec([-right, down, 0.0])


def turned_gaze(retina: Image, shift_px: tuple[float, float], turn_deg: float, seed: int, px_per_deg: float) -> Image:
    """Return a picture of an eye that has turned, for a retina that is linear in the angle from its middle."""
    middle = (GAZE_SIZE - 1) / 2
    here = np.indices((GAZE_SIZE, GAZE_SIZE)).reshape(2, -1).T - middle
    eye = eye_turn(np.array(shift_px), turn_deg, px_per_deg)
    there = places(eye.inv().apply(directions(here, px_per_deg)), px_per_deg)
    at = there.T + (np.array(retina.shape)[:, None] - 1) / 2
    seen = ndimage.map_coordinates(retina, at, order=3).reshape(GAZE_SIZE, GAZE_SIZE)
    seen = seen + NOISE * np.random.default_rng(seed).normal(size=seen.shape)
    return np.asarray(seen * disc((GAZE_SIZE, GAZE_SIZE), (middle, middle), GAZE_FIELD_PX / 2), np.float32)


def sparse_retina(seed: int) -> Image:
    """Return an even retina with a few vessels of 15 % contrast, as weak as those of a frame with little light."""
    random, size, t = np.random.default_rng(seed), 520, np.linspace(-0.2, 1.2, 4000)[:, None]
    vessels = np.zeros((size, size))
    for _ in range(6):
        a, b, c, d = random.uniform(0, size, (4, 2))
        course = a * (1 - t) ** 3 + 3 * b * t * (1 - t) ** 2 + 3 * c * t**2 * (1 - t) + d * t**3
        places_px = np.round(course).astype(int)
        vessels[tuple(places_px[((places_px >= 0) & (places_px < size)).all(axis=1)].T)] = 1
    wide = ndimage.gaussian_filter(vessels, 1.5)
    return np.asarray(1 - 0.15 * np.minimum(wide / np.quantile(wide[vessels > 0], 0.5), 1), np.float32)


def small_field_gaze(retina: Image, shift_px: tuple[float, float], seed: int) -> Image:
    """Return a picture of 540 x 960 pixels whose field of 33.4 degrees has 260, a tenth of the frame."""
    size, middle, top = 320, 159.5, (retina.shape[0] - 320) // 2
    seen = ndimage.shift(retina, shift_px, order=3, mode="nearest")[top : top + size, top : top + size]
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=seen.shape), 1.5)
    lit = (seen + 0.15 * noise) * disc((size, size), (middle, middle), 130)
    return np.pad(np.asarray(lit, np.float32), ((110, 110), (320, 320)))
