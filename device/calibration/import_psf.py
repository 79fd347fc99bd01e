"""Import of a PSF image from another laboratory as a calibration that lists its unknown values."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from device.config.bayer import BayerOption, pattern_of
from device.config.image_files import (
    Raw,
    as_companion,
    as_psf,
    as_raw,
    only_frame,
    read_counts,
    read_counts_file,
    require_same_shape,
    saturated_share,
)
from device.config.marked_files import is_marked_simulated
from device.errors import FrameError, PsfError
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.values import Calibration, Image, Psf, Sensor

MAX_SATURATED_SHARE = 0.01  # share of the light
ALWAYS_UNKNOWN = ("serial", "gain_e_per_dn", "read_noise_e", "geometry", "field_deg", "dark_dn", "flat", "bad")


@dataclass(frozen=True)
class ImportedPsfInfo:
    """Optional data beside the PSF images: black level, white level, pixel pitch, and the file of a dark frame.

    `bayer`: the images are mosaics of this pattern, or "none"; None: as their files say, if their pixels agree.
    """

    black_dn: float | None = None
    white_dn: float | None = None
    pitch_um: float | None = None
    dark: Path | None = None
    bayer: BayerOption | None = None


@dataclass(frozen=True)
class ImportedPsf:
    """Imported PSF: the calibration, the names of its unknown values, additional figures, and notes for the user."""

    calibration: Calibration
    unknown: tuple[str, ...]
    figures: tuple[tuple[str, float], ...]
    notes: tuple[str, ...] = ()


def read_imported_psf(paths: tuple[Path, ...], info: ImportedPsfInfo) -> ImportedPsf:
    """Return the imported calibration: one PSF, or a stack over depth in the order of `paths`.

    The dark frame, if there is one, is subtracted first; then `as_psf` removes the pedestal. PsfError if an image is no
    PSF, is saturated, is a colour mosaic, or has another shape than the first image or the dark frame.
    """
    read = [_read(path, info) for path in paths]
    psfs = tuple(psf for psf, _, _ in read)
    for psf in psfs:
        require_same_shape((psf,), psfs[0].shape)
    defaults = Sensor()
    sensor = Sensor(
        black_dn=defaults.black_dn if info.black_dn is None else info.black_dn,
        white_dn=defaults.white_dn if info.white_dn is None else info.white_dn,
    )
    unknown = [*ALWAYS_UNKNOWN, *(name for name in ("black_dn", "white_dn") if getattr(info, name) is None)]
    figures = [("psf_saturated", max(share for _, share, _ in read))]
    if info.pitch_um is not None:
        figures.append(("pitch_um", info.pitch_um))
    simulated = any(is_marked_simulated(path) for path in paths)
    notes = tuple(note for _, _, found in read for note in found)
    return ImportedPsf(Calibration(psfs, sensor, simulated=simulated), tuple(unknown), tuple(figures), notes)


def _read(path: Path, known: ImportedPsfInfo) -> tuple[Psf, float, tuple[str, ...]]:
    """Return a PSF, the share of its light in saturated pixels, and notes; PsfError for one that cannot be kept."""
    try:
        file = read_counts_file(path)
        array = only_frame(file.frames, str(path))
        pattern, notes = pattern_of(array, known.bayer, file.levels.bayer, file.levels.black_dn or 0.0, path.name)
        psf = without_hot_pixels(as_psf(array, path.name))
        raw = as_raw(array)
        dark = None if known.dark is None else as_companion(read_counts(known.dark), known.dark.name)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error
    if pattern is not None:
        raise PsfError(
            f"{path.name} is a colour mosaic ({pattern}), and a calibration keeps no PSF of a mosaic",
            "Give it beside its raw: diffuscope reconstruct --psf. If its sensor is monochrome, give --bayer none.",
        )
    share = saturated_share(psf, raw, known.white_dn)
    if share > MAX_SATURATED_SHARE:
        raise PsfError(
            f"{path.name} is saturated: {share:.1%} of its light is in pixels at their highest value",
            "Measure it with a shorter exposure, or give one that was not brightened for the eye.",
        )
    return psf if dark is None else _subtract_dark(dark, raw, path.name), share, notes


def _subtract_dark(dark: Image, raw: Raw, name: str) -> Psf:
    """Return the PSF of the raw image less the dark frame; PsfError if their shapes differ."""
    pixels = raw.pixels.astype(np.float32)
    if dark.shape != pixels.shape:
        raise PsfError(f"the dark frame has the shape {dark.shape}, {name} {pixels.shape}", "Give the PSF's own dark.")
    lit = pixels - dark / np.float32(2**raw.shift)
    lit[raw.bad | np.isnan(lit)] = np.nanmedian(lit)
    return without_hot_pixels(as_psf(lit, name))
