"""What the point source says when it is moved along the axis: by how much one dioptre stretches this head's PSF.

A point `moved_mm` behind the focus of the model eye's lens reaches the head as an eye of M = 1/f - 1/s, s = f + moved,
would send it (optics.md 1.3: +-4 mm behind 25 mm are +5.52 and -7.62 dpt of M). Its PSF is that of the relaxed eye,
stretched by 1 - k M (optics.md 2.4). The drawings say k = z a^2; the rail and the lens say what it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize

from device.calibration.point import Point
from device.errors import CalibrationRefused
from device.recon.geometry import support_radius_px
from device.values import Geometry, Psf

SAMPLE_UM = 10.0  # the caustic holds nothing finer than two of these (optics.md 2.1)
ROOM = 1.12  # of the PSF's own radius: where a stretched one still is
MOST_STRETCH, RUNGS = 0.08, 41  # of the coarse search; one rung moves the iris's edge by less than a grain
LEAST_LIKENESS = 0.9
MOST_SIDEWAYS_DEG = 0.25
LEAST_SHARE, MOST_SHARE = 0.5, 1.6  # of the stretch that the drawings promise
MOST_OFF_DPT = 0.2  # of one position beside the line: 0.12 mm of the rail
REMEDY = "Move the source along the axis only, to the places that are asked for, away from the lens where it says +."

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Stretch:
    """How a PSF became another: its scale, by how far it moved (rows, cols), and their correlation after both."""

    scale: float
    moved_px: tuple[float, float]
    likeness: float


@dataclass(frozen=True)
class Dioptres:
    """The factor that was found, its standard deviation, and how far the worst position is beside the line."""

    scale_per_dpt: float
    sd_per_dpt: float
    worst_dpt: float


def sphere_dpt(moved_mm: float, eye_mm: float) -> float:
    """The mean sphere M of a model eye whose point was moved by so much away from its lens; positive: myopia."""
    return 1000 / eye_mm - 1000 / (eye_mm + moved_mm)


def stretch(of: Psf, into: Psf, pitch_um: float) -> Stretch:
    """By how much the one PSF must be stretched about its middle, and moved, to become the other.

    The best of a ladder of scales by correlation over all shifts, then least squares in scale, shift and brightness.
    """
    n = max(1, round(SAMPLE_UM / pitch_um))
    radius = ROOM * support_radius_px(of)
    reference, seen = (_cut(psf, radius, n) for psf in (of, into))
    splines = ndimage.spline_filter(reference, order=3)
    start = _coarse(splines, seen)
    edge = max(min(seen.shape) / 2, 1.0)  # samples: a step of one in each unknown then moves light by one sample

    def miss(unknown: Floats) -> Floats:
        stretched = _warped(splines, 1 + unknown[0] / edge, (unknown[1], unknown[2]))
        return np.ravel(stretched * (_dot(stretched, seen) / _dot(stretched, stretched)) - seen)

    found = optimize.least_squares(miss, (edge * (start[0] - 1), *start[1:]), method="lm", diff_step=[1e-3] * 3).x
    scale = float(1 + found[0] / edge)
    best = _warped(splines, scale, (found[1], found[2]))
    likeness = float(np.corrcoef(best.ravel(), seen.ravel())[0, 1])
    return Stretch(scale, (float(n * found[1]), float(n * found[2])), likeness)


def between(first: Point, there: Point, pitch_um: float) -> Stretch:
    """The same of two measured points, which were both brought to the middle."""
    found = stretch(first.psf, there.psf, pitch_um)
    rows, cols = (a + b - c for a, b, c in zip(found.moved_px, there.off_px, first.off_px, strict=True))
    return replace(found, moved_px=(rows, cols))


def refuse_other_place(found: Stretch, moved_mm: float, eye_mm: float, geometry: Geometry) -> None:
    """A source that stands elsewhere than asked: not moved, moved the other way, moved sideways, or another one."""
    if found.likeness < LEAST_LIKENESS:
        said = f"at {moved_mm:+g} mm the PSF is not the stored one, only stretched: correlation {found.likeness:.2f}"
        raise CalibrationRefused(f"{said} (at least {LEAST_LIKENESS})", REMEDY)
    sideways_deg = hypot(*found.moved_px) / geometry.px_per_deg
    if sideways_deg > MOST_SIDEWAYS_DEG:
        said = f"at {moved_mm:+g} mm the source has moved sideways by {sideways_deg:.2f} degrees"
        raise CalibrationRefused(f"{said} (at most {MOST_SIDEWAYS_DEG})", REMEDY)
    share = (1 - found.scale) / (geometry.nominal_scale_per_dpt * sphere_dpt(moved_mm, eye_mm))
    if not LEAST_SHARE < share < MOST_SHARE:
        how = "the other way" if share < -LEAST_SHARE / 2 else "too little" if share < LEAST_SHARE else "too far"
        said = f"at {moved_mm:+g} mm the source has moved {how}: the PSF is stretched by {found.scale - 1:+.2%}"
        wanted = -geometry.nominal_scale_per_dpt * sphere_dpt(moved_mm, eye_mm)
        raise CalibrationRefused(f"{said} where about {wanted:+.2%} are due", REMEDY)


def measured_dioptres(scales: Mapping[float, float], eye_mm: float) -> Dioptres:
    """From the scale at each place (mm behind the focus) to the stretch per dioptre: the line 1 - k M through 1.

    The place of the stored PSF is 0 and its scale 1. An error of the whole rail by 0.1 mm makes k wrong by 0.8 %.
    """
    spheres_dpt = np.array([sphere_dpt(moved_mm, eye_mm) for moved_mm in scales])
    shrunk = 1 - np.array(list(scales.values()))
    if len(scales) < 2 or np.ptp(spheres_dpt) == 0:
        raise CalibrationRefused(f"{len(scales)} places make no line", "Move the source to two places or more.")
    squares = float(spheres_dpt @ spheres_dpt)
    factor = float(spheres_dpt @ shrunk) / squares
    off_dpt = (shrunk - factor * spheres_dpt) / factor
    worst = int(np.argmax(np.abs(off_dpt)))
    if abs(off_dpt[worst]) > MOST_OFF_DPT:
        raise CalibrationRefused(
            f"at {list(scales)[worst]:+g} mm the PSF is {off_dpt[worst]:+.2f} dpt beside the line of all places "
            f"(at most {MOST_OFF_DPT})", REMEDY,
        )  # fmt: skip
    sd = abs(factor) * sqrt(float(off_dpt @ off_dpt) / (len(scales) - 1) / squares)
    return Dioptres(factor, sd, float(off_dpt[worst]))


def _cut(psf: Psf, radius_px: float, n: int) -> Floats:
    """The part of a PSF around its middle, n x n pixels to a sample; as many samples on both sides of the middle."""
    sides = []
    for size in psf.shape:
        samples = min(int(2 * radius_px), size) // n
        first = size // 2 - samples // 2 * n
        sides.append(slice(max(first, 0), max(first, 0) + samples * n))
    part = psf.pixels[tuple(sides)].astype(np.float64)
    rows, cols = (size // n for size in part.shape)
    return np.asarray(part.reshape(rows, n, cols, n).sum((1, 3)))


def _dot(a: Floats, b: Floats) -> float:
    return float(np.einsum("ij,ij->", a, b))  # np.vdot would wake a thread for every core, and wait for it


def _warped(splines: Floats, scale: float, moved: tuple[float, float]) -> Floats:
    """Stretched about its middle, then moved (rows, cols), in samples."""
    middle = np.array([size // 2 for size in splines.shape])
    offset = middle - (middle + np.array(moved)) / scale
    return np.asarray(
        ndimage.affine_transform(splines, np.array([1 / scale, 1 / scale]), offset, order=3, prefilter=False)
    )


def _coarse(splines: Floats, seen: Floats) -> tuple[float, float, float]:
    """The rung of the ladder that correlates best at any shift: scale, rows, cols."""
    spectrum = fft.rfft2(seen - seen.mean())
    best = (-np.inf, 1.0, 0.0, 0.0)
    for scale in np.linspace(1 - MOST_STRETCH, 1 + MOST_STRETCH, RUNGS):
        tried = _warped(splines, float(scale), (0.0, 0.0))
        tried -= tried.mean()
        alike = fft.irfft2(spectrum * np.conj(fft.rfft2(tried)), seen.shape) / sqrt(_dot(tried, tried))
        at = np.unravel_index(int(np.argmax(alike)), alike.shape)
        row, col = ((int(i) + size // 2) % size - size // 2 for i, size in zip(at, seen.shape, strict=True))
        best = max(best, (float(alike[at]), float(scale), float(row), float(col)))
    return best[1:]
