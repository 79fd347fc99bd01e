"""A PSF that others measured, as a calibration that says what nobody knows of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError, PsfError
from device.images import Raw, as_psf, as_raw, read_image, refuse_other_sizes, says_simulated
from device.values import Calibration, Psf, Sensor

SATURATED, SPECKS = 0.01, 8  # of the light; so few pixels may be the brightest by chance
ALWAYS_UNKNOWN = ("serial", "gain_e_per_dn", "read_noise_e", "geometry", "field_deg", "dark_dn", "flat", "bad")


@dataclass(frozen=True)
class Hearsay:
    """What may be known besides the images: the sensor's counts, its pitch, and a dark frame of the PSF's exposure."""

    black_dn: float | None = None
    white_dn: float | None = None
    pitch_um: float | None = None
    dark: Path | None = None


@dataclass(frozen=True)
class Others:
    """A PSF of others: the calibration, the names of what is unknown in it, and figures that were found."""

    calibration: Calibration
    unknown: tuple[str, ...]
    figures: tuple[tuple[str, float], ...]


def read_others(paths: tuple[Path, ...], known: Hearsay) -> Others:
    """One PSF, or a stack over depth in the order given; PsfError for what is no PSF, or has lost its brightest light.

    The pedestal is removed as `as_psf` does, after the dark frame if there is one.
    """
    read = [_read(path, known) for path in paths]
    psfs = tuple(psf for psf, _ in read)
    for psf in psfs:
        refuse_other_sizes((psf,), psfs[0].shape)
    defaults = Sensor()
    sensor = Sensor(
        black_dn=defaults.black_dn if known.black_dn is None else known.black_dn,
        white_dn=defaults.white_dn if known.white_dn is None else known.white_dn,
    )
    unknown = [*ALWAYS_UNKNOWN, *(name for name in ("black_dn", "white_dn") if getattr(known, name) is None)]
    figures = [("psf_saturated", max(share for _, share in read))]
    if known.pitch_um is not None:
        figures.append(("pitch_um", known.pitch_um))
    simulated = any(says_simulated(path) for path in paths)
    return Others(Calibration(psfs, sensor, simulated=simulated), tuple(unknown), tuple(figures))


def _read(path: Path, known: Hearsay) -> tuple[Psf, float]:
    try:
        array = read_image(path)
        psf = as_psf(array, path.name)
        raw = as_raw(array)
        dark = None if known.dark is None else read_image(known.dark)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error
    share = _saturated(psf, raw, known.white_dn)
    if share > SATURATED:
        raise PsfError(
            f"{path.name} is saturated: {share:.1%} of its light is in pixels at their highest value",
            "Measure it with a shorter exposure, or give one that was not brightened for the eye.",
        )
    return (psf, share) if dark is None else (_without(dark, raw, path.name), share)


def _saturated(psf: Psf, raw: Raw, white_dn: float | None) -> float:
    """The share of the light in pixels that are at the converter's end, or of floats at the image's own highest."""
    brightest = raw.pixels if raw.pixels.ndim == 2 else raw.pixels.max(axis=2)
    white = min(raw.white_dn, float("inf") if white_dn is None else white_dn)
    top = (brightest >= min(white, float(brightest.max()))) if np.isinf(white) else brightest >= white
    if np.count_nonzero(top) <= SPECKS:
        return 0.0
    return float(psf.pixels[top].sum(dtype=np.float64))


def _without(dark: NDArray[Any], raw: Raw, name: str) -> Psf:
    pixels = raw.pixels.astype(np.float32)
    if dark.shape != pixels.shape:
        raise PsfError(f"the dark frame has the shape {dark.shape}, {name} {pixels.shape}", "Give the PSF's own dark.")
    lit = pixels - dark.astype(np.float32) / np.float32(2**raw.shift)
    lit[raw.bad] = np.median(lit)
    return as_psf(lit, name)
