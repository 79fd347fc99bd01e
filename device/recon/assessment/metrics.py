"""Full-reference metrics of a picture: PCC, PSNR, SSIM, high-pass PCC and vessel contrast against a known truth.

A picture is linear in arbitrary units, so every score that compares values first fits truth = gain x + offset by least
squares inside the region; the span of the truth there is the data range (1 after scaling). After that fit PSNR is a
function of PCC, -10 log10(var (1 - PCC^2)), with var the variance of the truth in units of its span: one axis can show
both.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.errors import FrameError
from device.values import Image, Mask

FIT = "least-squares gain and offset of the picture onto the truth inside the region"
RANGE = "the truth's span (largest minus smallest value) inside the region"
SSIM_SIGMA_PX = 1.5  # an 11 x 11 window
SSIM_REACH_PX = 5
K1, K2 = 0.01, 0.03
MAX_SHIFT_PX = 32

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Scores:
    """Scores of one picture against its truth.

    Attributes
    ----------
    pcc
        Pearson's correlation coefficient.
    psnr_db
        Peak signal-to-noise ratio in dB.
    ssim
        Structural similarity.
    highpass_pcc
        Correlation of the details.
    vessel_contrast
        Contrast of the vessels, in units of the truth; None if they are unknown. `truth_contrast` is that of the truth.
    """

    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None


class PictureScorer:
    """Scoring of pictures against one truth in one region.

    Parameters
    ----------
    truth
        True object, float32 (rows, cols), NaN where it is unknown.
    inside
        Mask of the region, (rows, cols).
    detail_px
        Sigma of the blur that the high-pass correlation subtracts, and reach of a vessel's background.
    vessels
        Mask of the pixels of vessels; None if unknown.

    Raises
    ------
    FrameError
        The shapes differ, or the truth has fewer than 16 finite values or no contrast in the region.
    """

    def __init__(self, truth: Image, inside: Mask, detail_px: float, vessels: Mask | None = None) -> None:
        if truth.shape != inside.shape or truth.ndim != 2:
            raise FrameError(f"a truth of the shape {truth.shape} does not fit a region of {inside.shape}")
        self._shape = truth.shape
        self._box = _around(inside)
        truth = truth[self._box]  # pixels outside are not used
        inside = inside[self._box]
        self.inside = inside & np.isfinite(truth)
        values = truth[self.inside].astype(np.float64)
        span = float(np.ptp(values)) if values.size else 0.0
        if values.size < 16 or not span > 0:
            raise FrameError(
                "the truth is the same everywhere in the region, so nothing can be compared with it",
                "Give the truth on the sensor's grid: one value per pixel of the raw frame.",
            )
        self.detail_px = detail_px
        self._low = float(values.min())
        self.span = span
        self.truth: Plane = np.where(self.inside, (np.nan_to_num(truth) - self._low) / span, 0)
        self.vessels = None if vessels is None else vessels[self._box] & self.inside
        self.truth_variance = float(self.truth[self.inside].var())
        self.core = ndimage.binary_erosion(self.inside, np.ones((3, 3), np.bool_), iterations=SSIM_REACH_PX)

    @cached_property
    def _detail(self) -> Plane:
        return highpass(self.truth, self.inside, self.detail_px)

    def __call__(self, picture: Image) -> Scores:
        """Return the scores of one picture.

        Parameters
        ----------
        picture
            Linear, (rows, cols), in any units.

        Returns
        -------
        Scores
            Ratios, and the signal-to-noise ratio in dB.

        Raises
        ------
        FrameError
            The picture has another shape.
        """
        if picture.shape != self._shape:
            raise FrameError(f"a picture of the shape {picture.shape} does not fit a truth of {self._shape}")
        x = np.where(self.inside, picture[self._box], 0).astype(np.float64)
        fitted = np.where(self.inside, fit_intensity(x, self.truth, self.inside), 0)
        return Scores(
            pcc=pcc(x, self.truth, self.inside),
            psnr_db=psnr_db(fitted, self.truth, self.inside),
            ssim=ssim(fitted, self.truth, self.core if self.core.any() else self.inside),
            highpass_pcc=pcc(highpass(x, self.inside, self.detail_px), self._detail, self.inside),
            vessel_contrast=self._contrast(fitted),
        )

    @property
    def truth_contrast(self) -> float | None:
        """Vessel contrast of the truth itself, see `vessel_contrast`; None if the vessels are unknown."""
        return self._contrast(self.truth)

    def _contrast(self, fitted: Plane) -> float | None:
        if self.vessels is None or not self.vessels.any():
            return None
        return vessel_contrast(fitted * self.span + self._low, self.vessels, self.inside, self.detail_px)


def _around(inside: Mask) -> tuple[slice, slice]:
    """Return the rows and columns of the region with a margin of six pixels for its erosion."""
    spans = []
    for axis, size in enumerate(inside.shape):
        there = np.flatnonzero(inside.any(axis=1 - axis))
        low, high = (int(there[0]), int(there[-1]) + 1) if there.size else (0, size)
        spans.append(slice(max(low - SSIM_REACH_PX - 1, 0), min(high + SSIM_REACH_PX + 1, size)))
    return spans[0], spans[1]


def pcc(x: Plane, truth: Plane, inside: Mask) -> float:
    """Return Pearson's correlation over the region; 0 if one of the two is constant."""
    a = x[inside] - x[inside].mean()
    b = truth[inside] - truth[inside].mean()
    norm = float(np.sqrt((a @ a) * (b @ b)))
    varies = norm > 1e-12 * inside.sum() * max(
        float(np.abs(x[inside]).max()) * float(np.abs(truth[inside]).max()), 1e-300
    )
    return float(np.clip(a @ b / norm, -1, 1)) if varies else 0.0


def fit_intensity(x: Plane, truth: Plane, inside: Mask) -> Plane:
    """Return gain x + offset, the least-squares fit of x to the truth inside the region."""
    a = x[inside]
    b = truth[inside]
    spread = float(a.var())
    gain = float(((a - a.mean()) * (b - b.mean())).mean()) / spread if spread > 0 else 0.0
    return np.asarray(gain * (x - a.mean()) + b.mean())


def psnr_db(fitted: Plane, truth: Plane, inside: Mask) -> float:
    """Return 10 log10(1 / mean squared error) in dB over the region, at most 200; both in units of the data range."""
    error = fitted[inside] - truth[inside]
    return float(-10 * np.log10(max(float((error**2).mean()), 1e-20)))


def ssim(fitted: Plane, truth: Plane, core: Mask) -> float:
    """Return the mean structural similarity (SSIM, Wang et al. 2004) over `core`.

    Gaussian window, sigma 1.5 px, 11 x 11; K1 0.01, K2 0.03, range 1; weighted (not sample) covariance. If `core` is
    the region eroded by five pixels, no pixel outside the region is used.
    """
    blur = _window
    mean_x = blur(fitted)
    mean_t = blur(truth)
    var_x = blur(fitted * fitted) - mean_x**2
    var_t = blur(truth * truth) - mean_t**2
    cov = blur(fitted * truth) - mean_x * mean_t
    similarity = (2 * mean_x * mean_t + K1**2) * (2 * cov + K2**2)
    similarity /= (mean_x**2 + mean_t**2 + K1**2) * (var_x + var_t + K2**2)
    return float(similarity[core].mean())


def _window(image: Plane) -> Plane:
    return np.asarray(ndimage.gaussian_filter(image, SSIM_SIGMA_PX, radius=SSIM_REACH_PX))


def highpass(x: Plane, inside: Mask, sigma_px: float) -> Plane:
    """Return x minus its Gaussian blur inside the region (normalised convolution, no dark edge); 0 outside."""
    return np.where(inside, x - _local_mean(x, inside, sigma_px), 0)


def _local_mean(x: Plane, among: Mask, sigma_px: float) -> Plane:
    """Return the Gaussian mean of x over the pixels of `among` near each pixel."""
    weight = ndimage.gaussian_filter(among.astype(np.float64), sigma_px, mode="constant")
    total = ndimage.gaussian_filter(np.where(among, x, 0), sigma_px, mode="constant")
    return np.asarray(total / np.maximum(weight, 1e-9))


def vessel_contrast(x: Plane, vessels: Mask, inside: Mask, reach_px: float) -> float:
    """Return the mean of (background - vessel) / background over the vessels' pixels; 0 if the background is dark.

    The background is the Gaussian mean (sigma `reach_px` / 2) of the pixels of the region that are not vessels.
    """
    background = _local_mean(x, inside & ~vessels, reach_px / 2)[vessels]
    lit = background > 1e-6 * max(float(np.abs(x[inside]).max()), 1e-300)
    return float(((background - x[vessels]) / background)[lit].mean()) if lit.any() else 0.0


def shift_px(picture: Image, truth: Image) -> tuple[int, int]:
    """Return the displacement (rows, cols) of the picture from the truth, at most 32 px each: the correlation peak.

    A measured PSF need not be centred; a shifted PSF only shifts the picture.
    """
    rows, cols = picture.shape
    spectra = [np.fft.rfft2(image - image.mean()) for image in (np.nan_to_num(picture), np.nan_to_num(truth))]
    product = spectra[0] * np.conj(spectra[1])
    surface = np.fft.irfft2(product / np.sqrt(np.abs(product) + 1e-30), (rows, cols))  # half whitened for a sharp peak
    down, across = (min(MAX_SHIFT_PX, (size - 1) // 2) for size in (rows, cols))
    near = np.roll(surface, (down, across), axis=(0, 1))[: 2 * down + 1, : 2 * across + 1]
    row, col = np.unravel_index(int(np.argmax(near)), near.shape)
    return int(row) - down, int(col) - across
