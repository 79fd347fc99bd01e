"""From a setup to electrons: the object through its caustics onto the sensor, no more work than the setup asks for.

The full linear convolution, cropped: nothing wraps round, and light from beyond the sensor's edge arrives on it. Not
the solver's operator.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import atan2, ceil, cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.special import j1

from device.optics.diffuser import Beam, Refraction, caustic
from device.sim.setup import Place, Setup
from device.spec import OpticsSpec
from device.values import Image

LIT = 0.05  # of the peak: what is darker does not count as lit
ROUNDOFF = 1e-6  # of the peak: darker than this is the rounding of a single-precision FFT, not light
RINGS = (0.0, 0.45, 0.75, 1.0)  # where in the field a local effect is evaluated, of the half field; between: mixed
SPOKES = 8


class Zone(NamedTuple):
    """A part of the object that shares one caustic."""

    place: Place
    object: Image


def electrons_per_s(setup: Setup) -> Image:
    """Expected electrons per second at full drive, float32 (rows, cols) of the sensor.

    The peak before any veil reaches the scene's `peak_e` in one exposure. Leaves the mean of the lit pixels, to which
    veils and the room's light refer, in the setup.
    """
    scene = setup.scene
    arriving = _arriving(setup)
    peak = float(arriving.max())
    arriving *= np.float32(scene.peak_e / scene.spec.camera.exposure_s / max(peak, 1e-30))
    if setup.veils or setup.ambient:
        lit = arriving > LIT * float(arriving.max())
        setup.lit_e_per_s = float(arriving[lit].mean()) if lit.any() else 0.0
    for name, veil in setup.veils.items():
        with setup.timed(name):
            arriving += veil * np.float32(setup.lit_e_per_s)
    return arriving if setup.response is None else arriving * setup.response


def psf(setup: Setup, place: Place = (0.0, 0.0)) -> Image:
    """The caustic of one place: float32 (n, n) at the sensor's pitch; its sum is what the iris lets pass."""
    m, j0, j45 = setup.refraction
    for aberration in setup.aberrations.values():
        more = aberration(place)
        m, j0, j45 = m + more.m_dpt, j0 + more.j0_dpt, j45 + more.j45_dpt
    beam = None
    if setup.beams:
        shifts = [shift(place) for shift in setup.beams.values()]
        radius_um = setup.scene.sim.eye.pupil_um / 2 / setup.optics.angular_magnification
        beam = Beam(sum(x for x, _ in shifts), sum(y for _, y in shifts), radius_um)
    scene = setup.scene
    pitch_um = scene.spec.camera.pitch_um
    with setup.timed(*(["bandwidth"] if setup.lines > 1 else [])):
        return traced(setup.optics, pitch_um, scene.seed, Refraction(m, j0, j45), setup.lines, beam)


@lru_cache(maxsize=4)
def traced(
    optics: OpticsSpec, pitch_um: float, seed: int, refraction: Refraction, lines: int, beam: Beam | None
) -> Image:
    """A caustic, traced once: the frame, its truth's PSF and the calibration often share it. Read-only."""
    point = caustic(optics, pitch_um, seed, refraction, lines, beam)
    point.flags.writeable = False
    return point


def _arriving(setup: Setup) -> Image:
    """The object through its caustics, in any unit."""
    with setup.timed(*setup.aberrations, *setup.beams):
        parts = [(part, psf(setup, place)) for place, part in zones(setup)]
        rows, cols = setup.shape
        margin = ceil(abs(setup.lag_px) * rows / 2)  # what a rolling shutter may still bring in from beside the sensor
        arriving = blurred(parts, (rows, cols + 2 * margin), setup.drift_px)
    if setup.lag_px:
        with setup.timed("shutter"):
            arriving = _sheared(arriving, setup.lag_px)[:, margin : margin + cols]
    return arriving


def blurred(parts: Sequence[tuple[Image, Image]], shape: tuple[int, int], drift_px: Place = (0.0, 0.0)) -> Image:
    """The light on a sensor of `shape` from parts of an object, each through its PSF, smeared by a drift.

    The parts (rows, cols) lie on one square around the middle, the PSFs have one shape.
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
    arriving = fitted(whole, shape, middle)
    arriving[arriving < ROUNDOFF * float(whole.max())] = 0
    return arriving


def zones(setup: Setup) -> Iterator[Zone]:
    """The object in parts that share a caustic: all of it where nothing changes over the field."""
    spec, gaze = setup.scene.sim.object, setup.scene.sim.eye.gaze_deg
    if not setup.aberrations and not setup.beams:
        yield Zone((0.0, 0.0), setup.object)
    elif spec.kind == "point":  # one place has one caustic, exactly
        yield Zone((spec.at_deg[0] + gaze[0], spec.at_deg[1] + gaze[1]), setup.object)
    else:
        yield from _ring_zones(setup)


def _ring_zones(setup: Setup) -> Iterator[Zone]:
    """A partition of unity in rings and spokes: between two places their caustics are mixed."""
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


def _sheared(image: Image, lag_px: float) -> Image:
    """Each row as it is when it is read: moved along the rows by the drift until then (a rolling shutter)."""
    rows, cols = image.shape
    moved_px = (np.arange(rows) - rows // 2) * lag_px
    spectrum = fft.rfft(image, axis=1)
    spectrum *= np.exp(-2j * pi * moved_px[:, None] * fft.rfftfreq(cols)).astype(np.complex64)
    sheared: Image = fft.irfft(spectrum, cols, axis=1)
    return np.maximum(sheared, 0)


def dotted(point: Image, diameter_px: float) -> Image:
    """A caustic as a disc of that diameter makes it instead of a point: 2 J1(x) / x; float32, same sum."""
    shape = [fft.next_fast_len(n + int(diameter_px) + 2, real=True) for n in point.shape]
    x = pi * diameter_px * np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :])
    disc = np.where(x > 1e-6, 2 * j1(np.maximum(x, 1e-6)) / np.maximum(x, 1e-6), 1.0)
    margin = int(diameter_px) // 2 + 1
    padded = np.pad(point, margin)
    blurred_psf = fft.irfft2(fft.rfft2(padded, shape) * disc, shape)[: padded.shape[0], : padded.shape[1]]
    return np.maximum(blurred_psf, 0).astype(np.float32)


def azimuth_and_angle(place: Place) -> tuple[float, float]:
    """A place in polar coordinates: radians from the right towards down, and degrees from the axis."""
    return atan2(place[1], place[0]), hypot(*place)


def fitted(image: Image, shape: tuple[int, int], middle: tuple[int, int] | None = None) -> Image:
    """A copy on `shape`, cropped or zero-filled, with `middle` (default rows//2, cols//2) brought to the middle."""
    out = np.zeros(shape, np.float32)
    into, of = [], []
    for size, have, centre in zip(
        shape, image.shape, middle or (image.shape[0] // 2, image.shape[1] // 2), strict=True
    ):
        first = size // 2 - centre  # where the image's first row would come to lie
        into.append(slice(max(first, 0), max(min(first + have, size), 0)))
        of.append(slice(max(-first, 0), max(min(size - first, have), 0)))
    out[tuple(into)] = image[tuple(of)]
    return out
