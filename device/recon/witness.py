"""Whether the stored PSF is still the one that a frame was taken through, at whatever refraction the eye has.

A frame's spectrum is the retina's times the PSF's. The retina's power knows nothing of the speckle of |H|^2: in a
narrow ring of frequencies the frame's power rises with |H|^2 exactly as much as its mean says, or it is another PSF's.

    score = sum of cov(|Y|^2, |H|^2) / sum of g var(|H|^2)    over rings, each weighed by what it can tell

is near 1 for the right PSF and near 0 for a wrong one. Y is the tapered frame as it is: a residual from which something
blurred by the stored PSF was subtracted carries that PSF's speckle, and calls any PSF half right. optics.md 8.3, Q7.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.kernels import Pixels
from device.recon.prepare import Linear
from device.recon.refraction import LEAST_FREQUENCIES, Refractor, Search
from device.recon.rim import Rim
from device.values import Image

NEAR = 5  # samples: a hole in the frame is filled with the mean of its neighbours
RING = 250  # frequencies: narrower than the fringes that the field's edge draws, and enough for a covariance

Between = Callable[[], None]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Statement:
    """What one frame says about the PSF: the score and its standard deviation, and the eye's mean sphere M.

    `off_deg` is how far the illuminated field's middle is from the sensor's (down, right), `wider` by which share it is
    larger than calibrated.
    """

    score: float
    sd: float
    sphere_dpt: float
    off_deg: tuple[float, float]
    wider: float

    @property
    def most(self) -> float:
        """The score that it may be at the most, two standard deviations up: a dim frame is not a wrong PSF."""
        return self.score + 2 * self.sd


class Witness:
    """Asks the frames of one head, with what its Refractor has planned."""

    def __init__(self, refractor: Refractor) -> None:
        self._refractor = refractor
        band = refractor.band
        order = np.argsort(np.hypot(band.rows, band.cols))
        self._rings = np.array_split(order, max(1, order.size // RING))
        self._rim = Rim(refractor.model, refractor.low, refractor.high, refractor.taper)

    def __call__(self, counts: Pixels, dark: Pixels | None, between: Between = lambda: None) -> Statement | None:
        """What a frame (rows, cols) in counts says; None where nothing shines, or too few frequencies can tell.

        `between` is called every few milliseconds; what it raises ends the hearing.
        """
        of = self._refractor
        if of.band.where.size < LEAST_FREQUENCIES:
            return None
        frame = of.frame(counts, dark, of.defects(counts, dark))
        if not of.fit_smooth(frame, of.model.stored) > 0:
            return None
        of.residual(frame, 0.0)
        noise = of.noise_power(frame)

        def unlikelihood(m_dpt: float) -> float:
            between()
            return of.unlikelihood(frame, noise, m_dpt, of.band)

        search = Search(unlikelihood)
        sphere_dpt = search.walk(search.ladder(of.step_dpt), of.step_dpt / 4)
        unlikelihood(sphere_dpt)  # for its |H|^2
        score, sd = self._score(_filled(frame) - np.float32(of.residual(frame, sphere_dpt)), noise)
        of.model.refocus(of.otf(of.grid, sphere_dpt))
        edge, per_deg = self._rim.fit(frame.y, between), of.geometry.px_per_deg / of.grid.n
        return Statement(score, sd, sphere_dpt, (edge.off[0] / per_deg, edge.off[1] / per_deg), edge.wider)

    def _score(self, y: Image, noise: float) -> tuple[float, float]:
        of = self._refractor
        np.multiply(y, of.taper, out=of.fft.space)
        seen = np.abs(of.fft.forward().ravel()[of.band.where].astype(np.complex128)) ** 2
        power = of.band.power.astype(np.float64)
        found = expected = certainty = 0.0
        for ring in self._rings:
            energy, speckle = seen[ring], power[ring] - power[ring].mean()
            mean = float(energy.mean())
            level = max(mean - noise, 0.0) / float(power[ring].mean())
            spread = float(speckle @ speckle) / mean**2
            found += float(speckle @ energy) / mean**2
            expected += level * spread
            certainty += spread
        if expected <= 0:
            return 0.0, float("inf")
        return found / expected, certainty**0.5 / expected


def _filled(frame: Linear) -> Image:
    """The frame, its missing samples made up from their neighbours: a hole in bright light would look like noise."""
    holes = frame.good == 0
    if not holes.any():
        return frame.y
    there = np.where(holes, np.float32(0), np.float32(1))
    near = ndimage.uniform_filter(frame.y * there, NEAR) / np.maximum(ndimage.uniform_filter(there, NEAR), 1e-3)
    filled: Image = np.where(holes, near, frame.y)
    return filled
