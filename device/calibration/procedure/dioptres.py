"""Measured PSF scale per dioptre, from a point source that is moved along the optical axis.

A point `moved_mm` behind the focus of the model eye's lens has the vergence of an eye of M = 1/f - 1/s,
s = f + moved (OPTICS.md 1.3: +-4 mm behind 25 mm are +5.52 and -7.62 dpt of M). Its PSF is the PSF of the relaxed
eye, scaled by 1 - k M (OPTICS.md 2.6). The drawings give k = z a^2; this step measures k against the rail and the lens.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np
import scipy  # whose module optimize is imported at its first use: 22 MB that only a calibration needs
from numpy.typing import NDArray
from scipy import fft, ndimage

from device.calibration.procedure.point_source import PointSource
from device.calibration.procedure.spot_similarity import fit_spots
from device.errors import CalibrationRefused
from device.recon.model.grid import support_radius_px
from device.values import Geometry, Psf

SAMPLE_UM = 10.0  # the caustic is band-limited to two of these (OPTICS.md 2.4)
RADIUS_FACTOR = 1.12  # times the PSF radius: contains the scaled PSF too
MAX_STRETCH, SCALE_STEPS = 0.08, 41  # of the coarse search; one step moves the iris edge by less than one grain
MIN_LIKENESS = 0.9
MAX_SIDEWAYS_DEG = 0.25
MIN_SHARE, MAX_SHARE = 0.5, 1.6  # of the nominal stretch of the drawings
MAX_OFF_DPT = 0.2  # residual of one position: 0.12 mm of the rail
REMEDY = "Move the source along the axis only, to the places that are asked for, away from the lens where it says +."

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PsfSimilarity:
    """Similarity between two PSFs: scale, shift (rows, cols) in pixels, and the correlation after both."""

    scale: float
    moved_px: tuple[float, float]
    correlation: float


@dataclass(frozen=True)
class DioptreScale:
    """Fitted scale per dioptre, its standard deviation, and the residual of the worst position, dpt (with its sign)."""

    scale_per_dpt: float
    sd_per_dpt: float
    worst_dpt: float


def mean_sphere_dpt(moved_mm: float, eye_mm: float) -> float:
    """Return the mean sphere M, dpt, of a model eye (f = `eye_mm`), its point moved away; positive means myopia."""
    return 1000 / eye_mm - 1000 / (eye_mm + moved_mm)


def fit_similarity(of: Psf, into: Psf, pitch_um: float, geometry: Geometry | None = None) -> PsfSimilarity:
    """Return the scale about the centre, and the shift in pixels, that turn the PSF `of` into the PSF `into`.

    By the spots of lenslets, which `geometry` states. Else coarse search over a grid of scales by cross-correlation,
    then least squares in scale, shift and brightness.
    """
    by_spots = None if geometry is None else fit_spots(of, into, geometry)
    if by_spots is not None:
        return PsfSimilarity(*by_spots)
    n = max(1, round(SAMPLE_UM / pitch_um))
    radius = RADIUS_FACTOR * support_radius_px(of)
    reference, seen = (_binned_centre(psf, radius, n) for psf in (of, into))
    splines = ndimage.spline_filter(reference, order=3)
    start = _coarse_search(splines, seen)
    edge = max(min(seen.shape) / 2, 1.0)  # samples: one unit of each unknown then moves light by one sample

    def miss(unknown: Floats) -> Floats:
        stretched = _warped(splines, 1 + unknown[0] / edge, (unknown[1], unknown[2]))
        return np.ravel(stretched * (_dot(stretched, seen) / _dot(stretched, stretched)) - seen)

    found = scipy.optimize.least_squares(miss, (edge * (start[0] - 1), *start[1:]), method="lm", diff_step=[1e-3] * 3).x
    scale = float(1 + found[0] / edge)
    best = _warped(splines, scale, (found[1], found[2]))
    likeness = float(np.corrcoef(best.ravel(), seen.ravel())[0, 1])
    return PsfSimilarity(scale, (float(n * found[1]), float(n * found[2])), likeness)


def similarity_of_points(
    first: PointSource, second: PointSource, pitch_um: float, geometry: Geometry | None
) -> PsfSimilarity:
    """Return scale and shift from one point-source measurement to another, with the true shift of the source.

    Both PSFs are centred, so the difference of their offsets is added to the fitted shift.
    """
    found = fit_similarity(first.psf, second.psf, pitch_um, geometry)
    rows, cols = (a + b - c for a, b, c in zip(found.moved_px, second.off_px, first.off_px, strict=True))
    return replace(found, moved_px=(rows, cols))


def refuse_wrong_position(found: PsfSimilarity, moved_mm: float, eye_mm: float, geometry: Geometry) -> None:
    """Raise CalibrationRefused if the source did not move by about `moved_mm` along the axis, or is another source."""
    if found.correlation < MIN_LIKENESS:
        message = (
            f"at {moved_mm:+g} mm the PSF is not the stored one, only stretched: correlation {found.correlation:.2f}"
        )
        raise CalibrationRefused(f"{message} (at least {MIN_LIKENESS})", REMEDY)
    sideways_deg = hypot(*found.moved_px) / geometry.px_per_deg
    if sideways_deg > MAX_SIDEWAYS_DEG:
        message = f"at {moved_mm:+g} mm the source has moved sideways by {sideways_deg:.2f} degrees"
        raise CalibrationRefused(f"{message} (at most {MAX_SIDEWAYS_DEG})", REMEDY)
    share = (1 - found.scale) / (geometry.nominal_scale_per_dpt * mean_sphere_dpt(moved_mm, eye_mm))
    if not MIN_SHARE < share < MAX_SHARE:
        how = "the other way" if share < -MIN_SHARE / 2 else "too little" if share < MIN_SHARE else "too far"
        message = f"at {moved_mm:+g} mm the source has moved {how}: the PSF is stretched by {found.scale - 1:+.2%}"
        wanted = -geometry.nominal_scale_per_dpt * mean_sphere_dpt(moved_mm, eye_mm)
        raise CalibrationRefused(f"{message} where about {wanted:+.2%} are due", REMEDY)


def fit_dioptre_scale(scales: Mapping[float, float], eye_mm: float) -> DioptreScale:
    """Return the scale per dioptre from the scale at each position (mm behind the focus): the line 1 - k M through 1.

    The stored PSF is at position 0 with scale 1. An offset of the whole rail of 0.1 mm makes k wrong by 0.8 %.
    CalibrationRefused for fewer than two positions, or for one beside the line.
    """
    spheres_dpt = np.array([mean_sphere_dpt(moved_mm, eye_mm) for moved_mm in scales])
    shrunk = 1 - np.array(list(scales.values()))
    if len(scales) < 2 or np.ptp(spheres_dpt) == 0:
        raise CalibrationRefused(f"{len(scales)} places make no line", "Move the source to two places or more.")
    squares = float(spheres_dpt @ spheres_dpt)
    factor = float(spheres_dpt @ shrunk) / squares
    off_dpt = (shrunk - factor * spheres_dpt) / factor
    worst = int(np.argmax(np.abs(off_dpt)))
    if abs(off_dpt[worst]) > MAX_OFF_DPT:
        raise CalibrationRefused(
            f"at {list(scales)[worst]:+g} mm the PSF is {off_dpt[worst]:+.2f} dpt beside the line of all places "
            f"(at most {MAX_OFF_DPT})",
            REMEDY,
        )
    sd = abs(factor) * sqrt(float(off_dpt @ off_dpt) / (len(scales) - 1) / squares)
    return DioptreScale(factor, sd, float(off_dpt[worst]))


def _binned_centre(psf: Psf, radius_px: float, n: int) -> Floats:
    """Return the central part of a PSF, up to `radius_px` from its centre on each axis, binned n x n to a sample."""
    sides = []
    for size in psf.shape:
        samples = min(int(2 * radius_px), size) // n
        first = size // 2 - samples // 2 * n
        sides.append(slice(max(first, 0), max(first, 0) + samples * n))
    part = psf.pixels[tuple(sides)].astype(np.float64)
    rows, cols = (size // n for size in part.shape)
    return np.asarray(part.reshape(rows, n, cols, n).sum((1, 3)))


def _dot(a: Floats, b: Floats) -> float:
    """Return the scalar product of two images."""
    return float(np.einsum("ij,ij->", a, b))  # np.vdot would start one BLAS thread per core and wait for it


def _warped(splines: Floats, scale: float, moved: tuple[float, float]) -> Floats:
    """Return the image of these spline coefficients, scaled about its centre, then shifted (rows, cols), in samples."""
    middle = np.array([size // 2 for size in splines.shape])
    offset = middle - (middle + np.array(moved)) / scale
    return np.asarray(
        ndimage.affine_transform(splines, np.array([1 / scale, 1 / scale]), offset, order=3, prefilter=False)
    )


def _coarse_search(splines: Floats, seen: Floats) -> tuple[float, float, float]:
    """Return the scale with the best correlation at any shift, and that shift in samples: scale, rows, cols."""
    spectrum = fft.rfft2(seen - seen.mean())
    best = (-np.inf, 1.0, 0.0, 0.0)
    for scale in np.linspace(1 - MAX_STRETCH, 1 + MAX_STRETCH, SCALE_STEPS):
        tried = _warped(splines, float(scale), (0.0, 0.0))
        tried -= tried.mean()
        alike = fft.irfft2(spectrum * np.conj(fft.rfft2(tried)), seen.shape) / sqrt(_dot(tried, tried))
        at = np.unravel_index(int(np.argmax(alike)), alike.shape)
        row, col = ((int(i) + size // 2) % size - size // 2 for i, size in zip(at, seen.shape, strict=True))
        best = max(best, (float(alike[at]), float(scale), float(row), float(col)))
    return best[1:]
