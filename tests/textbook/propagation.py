"""Textbook Fresnel propagation: caustic of a diffuser behind an eye with a given spectacle prescription.

It shares no code with `device`. The surface is drawn in real space and smoothed, the wave is propagated with the
paraxial transfer function, and the eye is given as sphere, minus cylinder and TABO axis of the correcting lens.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Optics:
    """Optics behind the eye, as in the paper: iris, distance diffuser to sensor, relay magnification, diffuser."""

    pitch_um: float
    iris_um: float = 3200.0
    distance_um: float = 6000.0
    magnification: float = 0.75  # of angles, eye to diffuser
    slope_fwhm_deg: float = 0.5
    correlation_um: float = 75.0
    wavelengths_um: tuple[float, ...] = (0.512, 0.522, 0.532)

    @property
    def px_per_deg(self) -> float:
        """Sensor pixels per degree of the eye's field, small angles."""
        return float(np.deg2rad(self.magnification * self.distance_um / self.pitch_um))


@dataclass(frozen=True)
class Prescription:
    """Correcting lens: sphere and minus cylinder in dpt, axis in degrees, counter-clockwise as seen by the examiner."""

    sphere_dpt: float = 0.0
    cylinder_dpt: float = 0.0
    axis_deg: float = 0.0

    @classmethod
    def of_power_vector(cls, m_dpt: float, j0_dpt: float, j45_dpt: float) -> "Prescription":
        """Return the prescription with mean sphere M and Jackson cross cylinders J0, J45 (Thibos 1997)."""
        half_dpt = float(np.hypot(j0_dpt, j45_dpt))
        axis_deg = float(np.rad2deg(np.arctan2(j45_dpt, j0_dpt)) / 2 % 180)
        return cls(m_dpt + half_dpt, -2 * half_dpt, axis_deg)

    def power_dpt(self, meridian_rad: Plane) -> Plane:
        """Return the power of the lens along meridians: a cylinder has none along its axis."""
        return np.asarray(self.sphere_dpt + self.cylinder_dpt * np.sin(meridian_rad - np.deg2rad(self.axis_deg)) ** 2)


def diffuser(optics: Optics, samples: int, seed: int) -> Plane:
    """Return the optical path of a smooth random surface in um, (samples, samples), at one sample per pixel."""
    noise = np.random.default_rng(seed).standard_normal((samples, samples))
    sigma = optics.correlation_um / 2 / optics.pitch_um  # the autocorrelation of smoothed noise is sqrt(2) wider
    rough = ndimage.gaussian_filter(noise, sigma, mode="wrap", truncate=5)
    slope = np.gradient(rough, optics.pitch_um, axis=0).std()
    return np.asarray(rough * (np.deg2rad(optics.slope_fwhm_deg) / 2.3548 / slope))


@cache
def transfer(optics: Optics, samples: int, wavelength_um: float) -> NDArray[np.complex128]:
    """Return the paraxial transfer function from diffuser to sensor, (samples, samples)."""
    frequency = fft.fftfreq(samples, optics.pitch_um)
    squared = frequency[:, None] ** 2 + frequency[None] ** 2
    return np.asarray(np.exp(-1j * np.pi * wavelength_um * optics.distance_um * squared))


def caustic(optics: Optics, surface_um: Plane, eye: Prescription) -> Plane:
    """Return the intensity on the sensor behind a retinal point of an uncorrected eye, unit sum, row 0 on top.

    The beam from the eye is focused where its correcting lens would have to make it parallel: its wavefront is
    -P(meridian) r^2 / 2 at the eye's pupil, with P the power that the lens takes away. The relay scales it by the
    square of the angular magnification.
    """
    samples = len(surface_um)
    across_um = (np.arange(samples) - samples // 2) * optics.pitch_um
    right, up = np.meshgrid(across_um, -across_um)
    radius_um = np.hypot(right, up)
    lacking_dpt = eye.power_dpt(np.arctan2(up, right))
    eye_um = optics.magnification**2 * lacking_dpt * 1e-6 * radius_um**2 / 2
    iris = np.clip((optics.iris_um / 2 - radius_um) / optics.pitch_um + 0.5, 0, 1)
    is_open = iris > 0
    path_um, share = (surface_um + eye_um)[is_open], iris[is_open]
    light, wave = np.zeros_like(surface_um), np.zeros(surface_um.shape, np.complex128)
    for wavelength_um in optics.wavelengths_um:
        wave[is_open] = share * np.exp(2j * np.pi / wavelength_um * path_um)
        spectrum = fft.fft2(wave, workers=1) * transfer(optics, samples, wavelength_um)
        light += np.abs(fft.ifft2(spectrum, overwrite_x=True, workers=1)) ** 2
    pixel = np.sinc(fft.fftfreq(samples, optics.pitch_um) * optics.pitch_um)
    light = fft.ifft2(fft.fft2(light) * pixel[:, None] * pixel[None]).real
    return np.asarray(light / light.sum())
