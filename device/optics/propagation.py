"""Light from one plane to the next: the angular spectrum, exact for a scalar field in free space.

transfer            the phase that each spatial frequency collects on the way
propagate           a field carried over a distance
require_sampling    refuse grids on which the above would lie (optics.md 2.2)
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.errors import SpecError

Field = NDArray[np.complex64]


def transfer(samples: int, dx_um: float, wavelength_um: float, distance_um: float) -> Field:
    """The phase that every spatial frequency collects over `distance_um`; evanescent waves end.

    Returns (samples, samples) complex64 in FFT order. The phase of the plane wave along the axis is left out:
    no intensity can show it, and single precision would drown in its ten thousand turns.
    """
    f_per_um = fft.fftfreq(samples, dx_um)
    sine_squared = (wavelength_um * f_per_um[:, None]) ** 2 + (wavelength_um * f_per_um[None, :]) ** 2
    cosine = np.sqrt(np.maximum(1 - sine_squared, 0))
    turns = -distance_um / wavelength_um * sine_squared / (1 + cosine)
    spectrum: Field = np.where(sine_squared < 1, np.exp(2j * np.pi * turns), 0).astype(np.complex64)
    return spectrum


def propagate(field: Field, dx_um: float, wavelength_um: float, distance_um: float) -> Field:
    """Carry a square complex field over a distance; energy is kept, and what leaves the window comes back in.

    `field` is (n, n) with samples `dx_um` apart; so is the result. Goodman, Introduction to Fourier Optics, 3.10.
    """
    spectrum = fft.fft2(field, overwrite_x=False)
    spectrum *= transfer(field.shape[0], dx_um, wavelength_um, distance_um)
    carried: Field = fft.ifft2(spectrum, overwrite_x=True)
    return carried


def require_sampling(
    samples: int, dx_um: float, *, wavelength_um: float, distance_um: float, aperture_um: float, angle_rad: float
) -> None:
    """Refuse a grid that cannot carry rays of `angle_rad` from an aperture over a distance; SpecError names the rule.

    optics.md 2.2: the steepest ray needs two samples per fringe, its landing place must lie in the window, and the
    chirp of the transfer function must be sampled.
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
