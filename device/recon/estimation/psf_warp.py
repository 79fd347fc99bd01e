"""PSF warp: a refractive error stretches the stored PSF linearly about the axis (OPTICS.md 2.6).

    I_T(x) = I_0(T^-1 x) / |det T|,   T = 1 - z a^2 [[M + J0, J45], [J45, M - J0]],   so   H_T(f) = H_0(T f)

z is the distance from diffuser to sensor, a the angular magnification; z a^2 is `Geometry.scale_per_dpt`. Against full
wave propagation the correlation is 0.9995 at 5 dpt. M > 0 means that the beam leaving the eye converges (myopia); the
correction at the pupil is -M.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft
from scipy import ndimage

from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Spectrum
from device.recon.model.forward_model import Model, dirichlet
from device.recon.model.grid import Pair, support_radius_px
from device.recon.model.kernels import Series
from device.recon.model.resolution import working_bin
from device.values import Geometry, Image, Psf

Transform = NDArray[np.float64]
PADDING = 6  # oversampling of the stored spectrum: the interpolation error at the PSF's edge is (1/11)^2 = 0.8 %
REACH = 1.06  # a stretch by 9 dpt extends 3 % beyond the last frequency, cylinders a little more
LARGEST = 4e6  # numbers in the table: 32 MB
COLUMNS = 32  # of the table that are transformed at a time: all at once would take 90 MB for a moment


class Wavefront(NamedTuple):
    """Mean sphere M and cylinder J0, J45 of an eye in dpt, as `transform` takes them."""

    m_dpt: float
    j0_dpt: float = 0.0
    j45_dpt: float = 0.0


class Stretch(Protocol):
    """Stretch of the PSF as a function of M, J0 and J45 of an eye in dpt."""

    def __call__(self, m_dpt: float, j0_dpt: float = 0.0, j45_dpt: float = 0.0) -> Transform:
        """Return the matrix on (x, y) = (cols, rows)."""


def transform(geometry: Geometry, m_dpt: float, j0_dpt: float = 0.0, j45_dpt: float = 0.0) -> Transform:
    """Return the stretch T of an eye with mean sphere M and cylinder J0, J45, as a matrix on (x, y) = (cols, rows)."""
    power_dpt = np.array([[m_dpt + j0_dpt, j45_dpt], [j45_dpt, m_dpt - j0_dpt]])
    return np.asarray(np.eye(2) - geometry.scale_per_dpt * power_dpt)


def warped(psf: Psf, transform: Transform) -> Psf:
    """Return the PSF stretched by `transform` about its centre, by cubic splines: same rows and columns, unit sum."""
    back = np.linalg.inv(transform)[::-1, ::-1]  # from (x, y) to (rows, cols)
    middle = np.array([size // 2 for size in psf.shape])
    pixels: Image = ndimage.affine_transform(psf.pixels, back, middle - back @ middle, order=3)
    return Psf(pixels, psf.name)


class InterpolatedOtf:
    """OTF of one PSF under any small stretch, by one look-up per frequency in its oversampled spectrum.

    The spectrum of the PSF, padded PADDING times, is interpolated bilinearly. Bilinear interpolation multiplies the PSF
    by sinc^2, which is divided out beforehand. Pixels beyond the support of the PSF (noise of the calibration) and
    frequencies in the stopband (`working_bin`) are left out.
    """

    def __init__(self, psf: Psf) -> None:
        self.reach = 0.5 / working_bin(psf)  # cycles per pixel, along either axis
        pixels, middle = _supported(psf)
        side = max(pixels.shape)
        padded = min(PADDING * side, int(np.sqrt(LARGEST / 2) / self.reach))
        self.pixels = int(scipy_fft.next_fast_len(max(padded, 2 * side, 32)))
        for axis, size in enumerate(pixels.shape):
            window = np.sinc((np.arange(size) - middle[axis]) / self.pixels) ** 2
            pixels /= np.expand_dims(window, 1 - axis)
        self._last = min(int(self.reach * REACH * self.pixels) + 2, self.pixels // 2 - 1)
        self._table = self._spectrum(pixels.astype(np.float32), middle)

    def _spectrum(self, pixels: Image, middle: Pair) -> Spectrum:
        """Return rows -last..last, columns 0..last, of the spectrum of the centred PSF; 1 at frequency 0."""
        last = self._last
        half = scipy_fft.rfft(pixels, self.pixels, axis=1)[:, : last + 1]
        half *= np.exp(2j * np.pi * middle[1] / self.pixels * np.arange(last + 1)).astype(np.complex64)
        table: Spectrum = np.empty((2 * last + 1, last + 1), np.complex64)
        total = float(half[:, 0].real.sum(dtype=np.float64))
        centred = np.exp(2j * np.pi * middle[0] / self.pixels * np.arange(-last, last + 1)) / total
        turn = centred.astype(np.complex64)[:, None]
        for begin in range(0, last + 1, COLUMNS):
            part = slice(begin, begin + COLUMNS)
            whole = scipy_fft.fft(half[:, part], self.pixels, axis=0)
            np.multiply(whole[-last:], turn[:last], out=table[:last, part])
            np.multiply(whole[: last + 1], turn[last:], out=table[last:, part])
        return table

    def on_grid(self, shape: Pair, n: int, transform: Transform, out: Spectrum | None = None) -> Spectrum:
        """Return the OTF of the stretched PSF for n x n pixels on a torus of `shape` samples, complex64
        (rows, cols//2 + 1), in `out` if given.
        """
        rows: Series = np.fft.fftfreq(shape[0]).astype(np.float64)
        cols: Series = np.fft.rfftfreq(shape[1]).astype(np.float64)
        otf = np.empty((rows.size, cols.size), np.complex64) if out is None else out
        scaled = transform * (self.pixels / n)
        row_share, col_share = (dirichlet(f, n).astype(np.float32) for f in (rows, cols))
        fused_kernels.stretch(self._table, scaled, rows, cols, row_share, col_share, otf)
        return otf

    def at_frequencies(self, rows: Series, cols: Series, share: Image, n: int, transform: Transform) -> Spectrum:
        """Return the OTF of the stretched PSF at frequencies `rows`, `cols` in cycles per sample of n x n pixels.

        `share` is the transfer of the sample at these frequencies.
        """
        otf = np.empty(rows.size, np.complex64)
        fused_kernels.stretch_at(self._table, transform * (self.pixels / n), rows, cols, share, otf)
        return otf


def picture_otf(interpolated: InterpolatedOtf, model: Model, transform: Transform) -> Spectrum:
    """Return the OTF of the stretched PSF on the grid of a model: the stored one plus what the stretch changes.

    Light beyond the support stays as it was calibrated. Without a stretch the result is the stored OTF.
    """
    grid = model.grid
    change = interpolated.on_grid(grid.shape, grid.n, transform)
    change -= interpolated.on_grid(grid.shape, grid.n, np.eye(2))
    change += model.stored
    return change


def _supported(psf: Psf) -> tuple[NDArray[np.float64], Pair]:
    """Return the part of a PSF inside its support radius, zero elsewhere, and the position of its centre."""
    radius_px = support_radius_px(psf)
    low = [max(size // 2 - int(radius_px), 0) for size in psf.shape]
    high = [min(size // 2 + int(radius_px) + 1, size) for size in psf.shape]
    middle = psf.shape[0] // 2 - low[0], psf.shape[1] // 2 - low[1]
    part = psf.pixels[low[0] : high[0], low[1] : high[1]].astype(np.float64)
    rows, cols = (np.arange(size) - centre for size, centre in zip(part.shape, middle, strict=True))
    part[np.hypot(rows[:, None], cols[None]) >= radius_px] = 0
    return part, middle
