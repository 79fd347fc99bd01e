"""Synthetic inputs for numerical tests: PSFs and calibrations without optics and files."""

import numpy as np

from device.clock import SystemClock, VirtualClock
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.values import Calibration, Geometry, Image, Psf, Sensor

PLANNER = Planner(folder=None, threads=1, effort="FFTW_ESTIMATE")
GEOMETRY = Geometry(pitch_um=20.16, diffuser_to_sensor_um=6000, angular_magnification=0.75)  # 3.9 px per degree


def speckle(shape: tuple[int, int], seed: int = 0, grain_px: float = 1.2) -> Image:
    """Return a caustic-like PSF: smoothed noise cubed inside a disc, positive, unit sum."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    f2 = np.fft.fftfreq(shape[0])[:, None] ** 2 + np.fft.rfftfreq(shape[1])[None] ** 2
    smooth = np.fft.irfft2(spectrum * np.exp(-2 * (np.pi * grain_px) ** 2 * f2), shape)
    rows = np.arange(shape[0])[:, None] - shape[0] // 2
    cols = np.arange(shape[1])[None] - shape[1] // 2
    psf = np.abs(smooth) ** 3 * (np.hypot(rows, cols) <= min(shape) * 0.3)
    psf[shape[0] // 2, shape[1] // 2] += 1e-12
    return (psf / psf.sum()).astype(np.float32)


def delta(shape: tuple[int, int]) -> Image:
    """Return a PSF without blur."""
    psf = np.zeros(shape, np.float32)
    psf[shape[0] // 2, shape[1] // 2] = 1
    return psf


def calibration(psf: Image, **changes: object) -> Calibration:
    """Return a calibration with one PSF; by default the field is unknown and the white level is that of 16 bits."""
    values: dict[str, object] = {"psfs": (Psf(psf),), "sensor": Sensor()} | changes
    return Calibration(**values)  # type: ignore[arg-type]


def reconstructor(cal: Calibration, shape: tuple[int, int], *recipes: Recipe) -> Reconstructor:
    """Return a reconstructor on virtual time; the default is one stage of `gradient` without binning."""
    return Reconstructor(cal, shape, PLANNER, VirtualClock(), recipes or (Recipe("gradient", 1),))


def reconstructor_on_system_clock(cal: Calibration, shape: tuple[int, int], *recipes: Recipe) -> Reconstructor:
    """Return the same reconstructor on the system clock."""
    return Reconstructor(cal, shape, PLANNER, SystemClock(), recipes or (Recipe("gradient", 1),))
