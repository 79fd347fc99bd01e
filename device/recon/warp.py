"""What a refractive error does to the stored PSF: it stretches it about the axis, and nothing else (optics.md 2.4).

    I_T(x) = I_0(T^-1 x) / |det T|,   T = 1 - z a^2 [[M + J0, J45], [J45, M - J0]],   so   H_T(f) = H_0(T f)

Against full wave propagation the correlation is 0.9995 at 5 dpt. M > 0 means that the beam leaving the eye converges
(myopia); a spectacle correction has the opposite sign.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft
from scipy import ndimage

from device.recon import sweeps
from device.recon.geometry import Pair, support_radius_px
from device.recon.kernels import Series
from device.recon.model import dirichlet
from device.recon.plan import Spectrum
from device.recon.resolution import working_bin
from device.values import Geometry, Image, Psf

Transform = NDArray[np.float64]
PADDING = 6  # oversampling of the stored spectrum: at the PSF's edge the look-up's ghost is (1/12)^2 = 0.7 %
REACH = 1.06  # a stretch by 9 dpt reads 3 % beyond the last frequency; cylinders a little more
LARGEST = 4e6  # numbers in the table: 32 MB


def transform(geometry: Geometry, m_dpt: float, j0_dpt: float = 0.0, j45_dpt: float = 0.0) -> Transform:
    """The stretch T of an eye with mean sphere M and cylinder J0, J45, as a matrix on (x, y) = (cols, rows)."""
    power_dpt = np.array([[m_dpt + j0_dpt, j45_dpt], [j45_dpt, m_dpt - j0_dpt]])
    return np.asarray(np.eye(2) - geometry.scale_per_dpt * power_dpt)


def warped(psf: Psf, transform: Transform) -> Psf:
    """The PSF stretched by `transform` about its centre, by cubic splines: same rows and columns, unit sum."""
    back = np.linalg.inv(transform)[::-1, ::-1]  # from (x, y) to (rows, cols)
    middle = np.array([size // 2 for size in psf.shape])
    pixels: Image = ndimage.affine_transform(psf.pixels, back, middle - back @ middle, order=3)
    return Psf(pixels, psf.name)


class ElasticOtf:
    """The OTF of one PSF under every small stretch: one look-up per frequency in its oversampled spectrum.

    The spectrum of a PSF padded PADDING times is read bilinearly; the triangle of that reading multiplies the PSF by
    sinc^2, which is divided out beforehand. What lies beyond the support is the calibration's noise and left out, as
    are frequencies that the optics does not pass (`working_bin`).
    """

    def __init__(self, psf: Psf) -> None:
        self.reach = 0.5 / working_bin(psf)  # cycles per pixel, along either axis
        pixels, middle = _supported(psf)
        side = max(pixels.shape)
        roomy = min(PADDING * side, int(np.sqrt(LARGEST / 2) / self.reach))
        self.pixels = int(scipy_fft.next_fast_len(max(roomy, 2 * side, 32)))
        for axis, size in enumerate(pixels.shape):
            window = np.sinc((np.arange(size) - middle[axis]) / self.pixels) ** 2
            pixels /= np.expand_dims(window, 1 - axis)
        self._last = min(int(self.reach * REACH * self.pixels) + 2, self.pixels // 2 - 1)
        self._table = self._spectrum(pixels.astype(np.float32), middle)

    def _spectrum(self, pixels: Image, middle: Pair) -> Spectrum:
        """Rows -last..last, columns 0..last, of the spectrum with the PSF's centre at the origin."""
        last = self._last
        half = scipy_fft.rfft(pixels, self.pixels, axis=1)[:, : last + 1]
        half *= np.exp(2j * np.pi * middle[1] / self.pixels * np.arange(last + 1)).astype(np.complex64)
        whole = scipy_fft.fft(half, self.pixels, axis=0)
        table = np.concatenate([whole[-last:], whole[: last + 1]])
        table *= np.exp(2j * np.pi * middle[0] / self.pixels * np.arange(-last, last + 1)).astype(np.complex64)[:, None]
        return np.asarray(table / table[last, 0].real, np.complex64)

    def on(self, shape: Pair, n: int, transform: Transform, out: Spectrum | None = None) -> Spectrum:
        """The OTF through n x n pixels on a torus of `shape` samples, (rows, cols//2 + 1), into `out` if given."""
        rows: Series = np.fft.fftfreq(shape[0]).astype(np.float64)
        cols: Series = np.fft.rfftfreq(shape[1]).astype(np.float64)
        otf = np.empty((rows.size, cols.size), np.complex64) if out is None else out
        scaled = transform * (self.pixels / n)
        row_share, col_share = (dirichlet(f, n).astype(np.float32) for f in (rows, cols))
        sweeps.stretched(self._table, scaled, rows, cols, row_share, col_share, otf)
        return otf

    def at(self, rows: Series, cols: Series, share: Image, n: int, transform: Transform) -> Spectrum:
        """The OTF at single frequencies, in cycles per sample of n x n pixels; `share` is the sample's own transfer."""
        otf = np.empty(rows.size, np.complex64)
        sweeps.stretched_at(self._table, transform * (self.pixels / n), rows, cols, share, otf)
        return otf


def _supported(psf: Psf) -> tuple[NDArray[np.float64], Pair]:
    """The part of a PSF that carries light, zero outside its support, and where its centre is in that part."""
    radius_px = support_radius_px(psf)
    rows, cols = (np.arange(size) - size // 2 for size in psf.shape)
    lit = np.where(np.hypot(rows[:, None], cols[None]) < radius_px, psf.pixels.astype(np.float64), 0)
    low = [max(size // 2 - int(radius_px), 0) for size in psf.shape]
    high = [min(size // 2 + int(radius_px) + 1, size) for size in psf.shape]
    part = np.ascontiguousarray(lit[low[0] : high[0], low[1] : high[1]])
    return part, (psf.shape[0] // 2 - low[0], psf.shape[1] // 2 - low[1])
