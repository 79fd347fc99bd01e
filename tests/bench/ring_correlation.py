"""Resolution of a picture by its Fourier ring correlation (FRC) with the truth."""

import numpy as np
from scipy import fft

from device.values import Image

EDGE_PX, TAPER = 4.0, 0.15  # left out at the field's edge, and width of the taper over the field's radius
RING = 3  # frequency steps of the transform in one ring
SMOOTHING = (0.25, 0.5, 0.25)
MIN_SQUARED = 0.5  # squared correlation with the truth from which on more than half of a ring's power is true


def resolution_lp_per_mm(picture: Image, truth: Image, radius_px: float, px_per_mm: float) -> float:
    """Return the frequency in line pairs per mm up to which |FRC|^2 is at least MIN_SQUARED.

    Parameters
    ----------
    picture
        Linear, (rows, cols), in any units.
    truth
        True object, of the same shape.
    radius_px
        Radius of the round field in the middle.
    px_per_mm
        Pixels per mm where the frequency is wanted.

    Returns
    -------
    float
        At most the Nyquist frequency; the field's shading, in the first ring, is no detail.
    """
    size = min(2 * (int(radius_px) + int(EDGE_PX)), *(n // 2 * 2 for n in truth.shape))
    along = np.arange(size) - (size - 1) / 2
    taper = np.clip((radius_px - EDGE_PX - np.hypot(along[:, None], along)) / (TAPER * radius_px), 0, 1)
    taper = taper**2 * (3 - 2 * taper)
    spectra = []
    for image in (picture, truth):
        first = [(n - size) // 2 for n in image.shape]
        cut = image[first[0] : first[0] + size, first[1] : first[1] + size].astype(np.float64)
        spectra.append(fft.rfft2((cut - (cut * taper).sum() / taper.sum()) * taper))
    ours, true = spectra
    rings = (np.hypot(fft.fftfreq(size)[:, None], fft.rfftfreq(size)) * size / RING).astype(int).ravel()
    count = size // (2 * RING)
    cross, power, true_power = (
        np.bincount(rings, part.real.ravel())[:count] for part in (ours * true.conj(), abs(ours) ** 2, abs(true) ** 2)
    )
    correlation = np.convolve(np.pad(cross / np.sqrt(power * true_power + 1e-30), 1, mode="edge"), SMOOTHING, "valid")
    lost = np.flatnonzero(correlation[1:] ** 2 < MIN_SQUARED)
    last = 1 + lost[0] if lost.size else count - 1
    return float((last + 0.5) * RING / size * px_per_mm)
