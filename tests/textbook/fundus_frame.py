"""Textbook frames of a fundus behind a diffuser: retina, lit field, blur, crop and sensor noise, in float64.

Nothing is shared with `device`: the retina is drawn by bilinear sampling of a photograph (or is synthetic), the field
edge is a cosine ramp, and the blur is a zero-padded linear convolution.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from tests.textbook.propagation import Optics, Plane

Counts = NDArray[np.uint16]


@dataclass(frozen=True)
class Camera:
    """Sensor: (rows, cols) pixels, full well and read noise in e-, bits and black level of its converter."""

    shape: tuple[int, int]
    full_well_e: float
    read_noise_e: float
    bits: int
    black_dn: float

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per count: the full well is the converter's range above the black level."""
        return self.full_well_e / (2.0**self.bits - 1 - self.black_dn)

    def read(self, electrons: Plane, rng: np.random.Generator) -> Counts:
        """Return the counts of an exposure, clipped to the converter's range."""
        charge = rng.poisson(np.maximum(electrons, 0)) + rng.normal(0, self.read_noise_e, electrons.shape)
        counts = np.rint(charge / self.gain_e_per_dn + self.black_dn)
        return np.clip(counts, 0, 2**self.bits - 1).astype(np.uint16)


@dataclass(frozen=True)
class FieldEdge:
    """Edge of the lit field: diameter and offset (right, down) in degrees, full width of its cosine ramp in degrees."""

    diameter_deg: float
    right_deg: float = 0.0
    down_deg: float = 0.0
    width_deg: float = 0.0

    def light(self, right_deg: Plane, down_deg: Plane) -> Plane:
        """Return the share of the light at positions in the field; it is one half at the diameter."""
        radius_deg = np.hypot(right_deg - self.right_deg, down_deg - self.down_deg)
        sharpest_deg = abs(float(right_deg[0, 1] - right_deg[0, 0]))  # one pixel
        inward = (self.diameter_deg / 2 - radius_deg) / max(self.width_deg, sharpest_deg) + 0.5
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(inward, 0, 1)))


def degrees(optics: Optics, samples: int) -> tuple[Plane, Plane]:
    """Return the field angles (right, down) in degrees of a square of pixels around the optical axis."""
    axis = (np.arange(samples) - (samples - 1) / 2) / optics.px_per_deg
    right_deg, down_deg = np.meshgrid(axis, axis)
    return right_deg, down_deg


def photographed(
    photo: Plane, right_deg: Plane, down_deg: Plane, zoom: float, turn_deg: float, shift_deg: tuple[float, float]
) -> Plane:
    """Return a photograph at field angles: `zoom` 1 fits the photograph's height to the angles' whole extent."""
    scale = photo.shape[0] / (float(np.ptp(right_deg)) * zoom)
    cos, sin = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    x, y = right_deg - shift_deg[0], down_deg - shift_deg[1]
    rows = (sin * x + cos * y) * scale + (photo.shape[0] - 1) / 2
    cols = (cos * x - sin * y) * scale + (photo.shape[1] - 1) / 2
    px_per_sample = scale * float(right_deg[0, 1] - right_deg[0, 0])
    smooth = ndimage.gaussian_filter(photo, max(px_per_sample / 2 - 0.5, 0))
    return np.asarray(ndimage.map_coordinates(smooth, [rows, cols], order=1, mode="nearest"))


def blurred(scene: Plane, psf: Plane, shape: tuple[int, int]) -> Plane:
    """Return the convolution of a square scene around the axis with a PSF, cropped to a sensor of `shape`."""
    full = [scene.shape[k] + psf.shape[k] - 1 for k in (0, 1)]
    size = [fft.next_fast_len(n, real=True) for n in full]
    light = fft.irfft2(fft.rfft2(scene, size) * fft.rfft2(psf, size), size)[: full[0], : full[1]]
    out = np.zeros(shape)
    spans = []
    for k in (0, 1):  # scene centre (n - 1)/2 and PSF centre n//2 meet the sensor's centre
        low = round((scene.shape[k] - 1) / 2 + psf.shape[k] // 2 - (shape[k] - 1) / 2)
        spans.append((low, max(0, -low), min(shape[k], full[k] - low)))
    (r, r0, r1), (c, c0, c1) = spans
    out[r0:r1, c0:c1] = light[r + r0 : r + r1, c + c0 : c + c1]
    return out
