"""Free-space propagation of scalar fields by the angular spectrum method (exact).

transfer            transfer function: phase of each spatial frequency over a distance
propagate           propagation of a field over a distance
require_sampling    check of a grid against the sampling conditions (OPTICS.md 2.3)
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.errors import SpecError

Field = NDArray[np.complex64]


def transfer(samples: int, dx_um: float, wavelength_um: float, distance_um: float) -> Field:
    """Return the transfer function over `distance_um`, (samples, samples) complex64; 0 for evanescent waves.

    Frequencies are in FFT order. The phase of the plane wave along the axis is left out: it does not change the
    intensity, and its ten thousand periods would exhaust single precision.
    """
    f_per_um = fft.fftfreq(samples, dx_um)
    sine_squared = (wavelength_um * f_per_um[:, None]) ** 2 + (wavelength_um * f_per_um[None, :]) ** 2
    cosine = np.sqrt(np.maximum(1 - sine_squared, 0))
    turns = -distance_um / wavelength_um * sine_squared / (1 + cosine)
    spectrum: Field = np.where(sine_squared < 1, np.exp(2j * np.pi * turns), 0).astype(np.complex64)
    return spectrum


def propagate(field: Field, dx_um: float, wavelength_um: float, distance_um: float) -> Field:
    """Return a square complex field after a distance; energy is conserved, and light beyond the window wraps around.

    `field` is (n, n) with samples `dx_um` apart; so is the result. Goodman, Introduction to Fourier Optics, 3.10.
    """
    spectrum = fft.fft2(field, overwrite_x=False)
    spectrum *= transfer(field.shape[0], dx_um, wavelength_um, distance_um)
    carried: Field = fft.ifft2(spectrum, overwrite_x=True)
    return carried


def require_sampling(
    samples: int, dx_um: float, *, wavelength_um: float, distance_um: float, aperture_um: float, angle_rad: float
) -> None:
    """Raise SpecError for a grid that cannot represent rays up to `angle_rad` from an aperture over a distance.

    The conditions, one of which the message names (OPTICS.md 2.3): two samples per fringe of the steepest ray, its end
    point inside the window, and a sampled chirp of the transfer function.
    """
    if dx_um > wavelength_um / (2 * angle_rad):
        raise SpecError(
            f"samples {dx_um:.3g} um apart cannot hold rays of {np.degrees(angle_rad):.2f} degrees;"
            f" they need {wavelength_um / (2 * angle_rad):.3g} um or less"
        )
    needed_um = aperture_um + 2 * distance_um * angle_rad
    if samples * dx_um < needed_um:
        raise SpecError(
            f"a window of {samples * dx_um:.0f} um is too small for light that spreads to {needed_um:.0f} um"
        )
    if samples * dx_um**2 < wavelength_um * distance_um:
        raise SpecError(
            f"{samples} samples of {dx_um:.3g} um do not resolve the transfer function over {distance_um:.0f} um"
        )
