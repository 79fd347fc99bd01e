"""Small made-up inputs for the numerics: PSFs, scenes and calibrations that need no optics and no files."""

import numpy as np

from device.clock import SystemClock, VirtualClock
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.values import Calibration, Geometry, Image, Psf, Sensor

PLANNER = Planner(folder=None, threads=1, effort="FFTW_ESTIMATE")
GEOMETRY = Geometry(pitch_um=20.16, diffuser_to_sensor_um=6000, angular_magnification=0.75)  # 3.9 px per degree


def speckle(shape: tuple[int, int], seed: int = 0, grain_px: float = 1.2) -> Image:
    """A caustic-like PSF: smoothed noise cubed inside a disc, positive, unit sum."""
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
    """A PSF that blurs nothing."""
    psf = np.zeros(shape, np.float32)
    psf[shape[0] // 2, shape[1] // 2] = 1
    return psf


def calibration(psf: Image, **changes: object) -> Calibration:
    """A calibration around one PSF; by default no field is known and nothing saturates below 16 bits."""
    facts: dict[str, object] = {"psfs": (Psf(psf),), "sensor": Sensor()} | changes
    return Calibration(**facts)  # type: ignore[arg-type]


def reconstructor(cal: Calibration, shape: tuple[int, int], *recipes: Recipe) -> Reconstructor:
    """A reconstructor on virtual time, unplanned beyond what the shape needs."""
    return Reconstructor(cal, shape, PLANNER, VirtualClock(), recipes or (Recipe("gradient", 1),))


def timed(cal: Calibration, shape: tuple[int, int], *recipes: Recipe) -> Reconstructor:
    """The same on the computer's clock."""
    return Reconstructor(cal, shape, PLANNER, SystemClock(), recipes or (Recipe("gradient", 1),))
