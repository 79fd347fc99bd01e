"""Forward model of the simulator: an optical setup to electrons per pixel, each part of the object through its PSF.

Full linear convolution, cropped: no wrap-around, and light from beyond the sensor's edge is included. Independent of
the solver's operator (no inverse crime).
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import atan2, ceil, cos, hypot, pi, radians, sin, tan
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.special import j1

from device.config.head_file import OpticsSpec
from device.optics.diffuser import Beam, Refraction, caustic
from device.optics.lenslets import IDEAL, LensState, Slope, spots
from device.sim.optical_setup import Ghost, OpticalSetup, Place
from device.values import Image

LIT_THRESHOLD = 0.05  # of the peak: threshold of the lit pixels
ROUNDOFF = 1e-6  # of the peak: below are rounding errors of the single-precision FFT
RINGS = (0.0, 0.45, 0.75, 1.0)  # sampling of local effects, in units of the half field; interpolated between
SPOKES = 8


class Zone(NamedTuple):
    """Isoplanatic zone: a weighted part of the object, (rows, cols), and the place whose PSF it shares."""

    place: Place
    object: Image


def electrons_per_s(setup: OpticalSetup) -> Image:
    """Return the expected electrons per second at full drive, float32 (rows, cols) of the sensor.

    Before veils and pixel response the peak reaches the scene's `peak_e` in one exposure; by a budget the mean of the
    lit disc is the budget's, sensor or not. With veils or ambient light,
    sets `lit_e_per_s` of `setup.added_light`, the mean of the lit pixels to which they refer. Ambient light itself is
    not included.
    """
    scene = setup.scene
    electrons = _image_on_sensor(setup)
    electrons *= np.float32(_gain_e(setup, electrons) / scene.spec.camera.exposure_s)
    added = setup.added_light
    if added.veils or added.ambient:
        lit = electrons > LIT_THRESHOLD * float(electrons.max())
        added.lit_e_per_s = float(electrons[lit].mean()) if lit.any() else 0.0
    for name, veil in added.veils.items():
        with setup.timed(name):
            electrons += veil * np.float32(added.lit_e_per_s)
    response = setup.whole_response
    return electrons if response is None else electrons * response


def _gain_e(setup: OpticalSetup, image: Image) -> float:
    """Return the electrons of one exposure per unit of `image`, by the scene's peak or by its budget."""
    scene = setup.scene
    budget = setup.scene.budget
    if budget is None:
        return scene.peak_e / max(float(image.max()), 1e-30)
    return budget.mean_e * budget.disc_px / max(float(setup.object.sum(dtype=np.float64)), 1e-30)


def psf(setup: OpticalSetup, place: Place = (0.0, 0.0)) -> Image:
    """Return the PSF of one place: float32 (n, n) at the sensor's pitch.

    Refraction, aberrations and beam shift of the setup are included. The sum is 1, or the share of the iris that a
    shifted beam fills. The array is read-only.
    """
    m, j0, j45 = setup.refraction
    for aberration in setup.aberrations.values():
        more = aberration(place)
        m = m + more.m_dpt
        j0 = j0 + more.j0_dpt
        j45 = j45 + more.j45_dpt
    beam = None
    if setup.beams:
        shifts = [shift(place) for shift in setup.beams.values()]
        radius_um = setup.scene.sim.eye.pupil_um / 2 / setup.optics.angular_magnification
        beam = Beam(sum(x for x, _ in shifts), sum(y for _, y in shifts), radius_um)
    scene = setup.scene
    pitch_um = scene.spec.camera.pitch_um
    with setup.timed(*(["bandwidth"] if setup.lines > 1 else [])):
        return cached_psf(
            setup.optics,
            pitch_um,
            scene.seed,
            Refraction(m, j0, j45),
            setup.lines,
            beam,
            setup.lenses,
            _slope_at_iris(setup, place),
        )


def _slope_at_iris(setup: OpticalSetup, place: Place) -> Slope:
    """Return the tangent (right, down) of the angle at which the light of a place meets curved lenses; else (0, 0)."""
    if not setup.lenses.curved:
        return 0.0, 0.0
    turn, angle_deg = azimuth_and_angle(place)
    tangent = tan(radians(setup.optics.angular_magnification * angle_deg))
    return tangent * cos(turn), tangent * sin(turn)


@lru_cache(maxsize=4)
def cached_psf(
    optics: OpticsSpec,
    pitch_um: float,
    seed: int,
    refraction: Refraction,
    lines: int,
    beam: Beam | None,
    lenses: LensState = IDEAL,
    slope: Slope = (0.0, 0.0),
) -> Image:
    """Return the PSF of the head's element as a read-only array, from a cache of the last four sets of arguments."""
    if optics.element.kind == "lenslets":
        point = spots(optics, pitch_um, seed, refraction, lines, beam, lenses.flaws, slope)
    else:
        point = caustic(optics, pitch_um, seed, refraction, lines, beam)
    point.flags.writeable = False
    return point


def _image_on_sensor(setup: OpticalSetup) -> Image:
    """Return the image of the object on the sensor, (rows, cols) in arbitrary units, with drift and rolling shutter."""
    with setup.timed(*setup.aberrations, *setup.beams):
        parts = [(part, psf(setup, place)) for place, part in zones(setup)]
        rows, cols = setup.shape
        margin = ceil(abs(setup.lag_px) * rows / 2)  # columns beside the sensor that a rolling shutter may shift in
        image = convolved(parts, (rows, cols + 2 * margin), setup.drift_px, setup.calibrated.ghost)
    if setup.lag_px:
        with setup.timed("shutter"):
            image = _shear_rows(image, setup.lag_px)[:, margin : margin + cols]
    return image


def convolved(
    parts: Sequence[tuple[Image, Image]],
    shape: tuple[int, int],
    drift_px: Place = (0.0, 0.0),
    ghost: Ghost | None = None,
) -> Image:
    """Return the image on a sensor of `shape` of parts of an object, each convolved with its PSF, with motion blur.

    `parts` are pairs of part and PSF; all parts have one shape and one centre, and all PSFs have one shape. `drift_px`
    (right, down) is the length of the blur; `ghost` adds the image once more.
    Values below 1e-6 of the peak are set to 0.
    """
    part, point = parts[0]
    full = part.shape[0] + point.shape[0] - 1, part.shape[1] + point.shape[1] - 1
    right, down = drift_px
    rows, cols = (fft.next_fast_len(n + ceil(abs(way)), real=True) for n, way in zip(full, (down, right), strict=True))
    total = np.zeros((rows, cols // 2 + 1), np.complex64)
    for part, point in parts:
        spectrum = fft.rfft2(part, (rows, cols), workers=2)
        spectrum *= fft.rfft2(point, (rows, cols), workers=2)
        total += spectrum
    if drift_px != (0.0, 0.0):
        total *= np.sinc(down * fft.fftfreq(rows)[:, None] + right * fft.rfftfreq(cols)).astype(np.float32)
    whole = fft.irfft2(total, (rows, cols), overwrite_x=True, workers=2)[: full[0], : full[1]]
    middle = part.shape[0] // 2 + point.shape[0] // 2, part.shape[1] // 2 + point.shape[1] // 2
    arriving = crop_or_pad(whole, shape, middle)
    if ghost is not None:
        displaced = middle[0] - ghost.down_px, middle[1] - ghost.right_px
        arriving += np.float32(ghost.share) * crop_or_pad(whole, shape, displaced)
    arriving[arriving < ROUNDOFF * float(whole.max())] = 0
    return arriving


def zones(setup: OpticalSetup) -> Iterator[Zone]:
    """Yield the isoplanatic zones of the object; only one for a point, or if no effect varies over the field."""
    spec = setup.scene.sim.object
    gaze = setup.scene.sim.eye.gaze_deg
    if not setup.aberrations and not setup.beams and not setup.lenses.curved:
        yield Zone((0.0, 0.0), setup.object)
    elif spec.kind == "point":  # a point has exactly one PSF
        yield Zone((spec.at_deg[0] + gaze[0], spec.at_deg[1] + gaze[1]), setup.object)
    else:
        yield from _ring_zones(setup)


def _ring_zones(setup: OpticalSetup) -> Iterator[Zone]:
    """Yield zones on rings and spokes; their weights sum to 1, so that PSFs are interpolated between the places."""
    half_deg = setup.scene.half_field_deg
    rows, cols = ((np.arange(n) - (n - 1) / 2) / setup.scene.geometry.px_per_deg for n in setup.object.shape)
    radius = np.hypot(rows[:, None], cols[None, :]) / half_deg
    turn = np.arctan2(rows[:, None], cols[None, :])
    for i, ring in enumerate(RINGS):
        weight = np.interp(radius, RINGS, np.eye(len(RINGS))[i])
        for spoke in range(SPOKES if ring else 1):
            angle = 2 * pi * spoke / SPOKES
            off = np.abs((turn - angle + pi) % (2 * pi) - pi) * SPOKES / (2 * pi)
            share = weight * np.maximum(1 - off, 0) if ring else weight
            place = (ring * half_deg * cos(angle), ring * half_deg * sin(angle))
            yield Zone(place, (setup.object * share).astype(np.float32))


def _shear_rows(image: Image, lag_px: float) -> Image:
    """Return the image with each row shifted right by `lag_px` per row from the middle row (rolling shutter)."""
    rows, cols = image.shape
    moved_px = (np.arange(rows) - rows // 2) * lag_px
    spectrum = fft.rfft(image, axis=1)
    spectrum *= np.exp(-2j * pi * moved_px[:, None] * fft.rfftfreq(cols)).astype(np.complex64)
    sheared: Image = fft.irfft(spectrum, cols, axis=1)
    return np.maximum(sheared, 0)


def convolved_with_disc(point: Image, diameter_px: float) -> Image:
    """Return a PSF convolved with a disc of that diameter: float32, same sum, enlarged by about a radius per side."""
    shape = [fft.next_fast_len(n + int(diameter_px) + 2, real=True) for n in point.shape]
    x = pi * diameter_px * np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :])
    disc = np.where(x > 1e-6, 2 * j1(np.maximum(x, 1e-6)) / np.maximum(x, 1e-6), 1.0)
    margin = int(diameter_px) // 2 + 1
    padded = np.pad(point, margin)
    blurred_psf = fft.irfft2(fft.rfft2(padded, shape) * disc, shape)[: padded.shape[0], : padded.shape[1]]
    return np.maximum(blurred_psf, 0).astype(np.float32)


def azimuth_and_angle(place: Place) -> tuple[float, float]:
    """Return a place in polar coordinates: azimuth from the right towards down, rad; angle from the axis, degrees."""
    return atan2(place[1], place[0]), hypot(*place)


def crop_or_pad(image: Image, shape: tuple[int, int], middle: tuple[int, int] | None = None) -> Image:
    """Return a float32 copy cropped or zero-padded to `shape`, with `middle` (default: rows//2, cols//2) as centre."""
    out = np.zeros(shape, np.float32)
    into = []
    of = []
    for size, have, centre in zip(
        shape, image.shape, middle or (image.shape[0] // 2, image.shape[1] // 2), strict=True
    ):
        first = size // 2 - centre  # target index of the image's first row
        into.append(slice(max(first, 0), max(min(first + have, size), 0)))
        of.append(slice(max(-first, 0), max(min(size - first, have), 0)))
    out[tuple(into)] = image[tuple(of)]
    return out
