"""The model that every solver shares: y = crop(h * x) + b, with x inside the field, on one planned grid."""

import numpy as np
from scipy import fft as scipy_fft

from device.recon.geometry import Grid, Pair, support_radius_px
from device.recon.plan import Planner, RealFft, Spectrum
from device.values import Calibration, Image, Psf


class Model:
    """One PSF on one grid: its planned FFT, its OTF, the field, and the field as the sensor would see it.

    `flat` (the window's shape) is crop(h * mask): what an evenly bright field would give. `fade` tapers a window that
    the picture's light runs past; None where it does not. `stored` is the OTF as calibrated, `otf` the one in use.
    """

    def __init__(self, psf: Psf, grid: Grid, planner: Planner) -> None:
        self.grid = grid
        self.fft: RealFft = planner.plan(grid.shape)
        self.mask = grid.field()
        self.box = _box(self.mask)
        self.row_gradient, self.col_gradient = gradient_symbol(grid.shape)
        self.stored = otf(psf, grid)
        self.refocus(self.stored)

    def refocus(self, otf: Spectrum) -> None:
        """See through another OTF on the same grid, one that a stretched PSF has; costs one FFT pair."""
        self.otf = otf
        self.flat = np.ascontiguousarray(self.blur(self.mask)[self.grid.slices])
        self.fade = taper(self.grid.window) if _runs_past_the_edge(self.flat) else None

    def blur(self, image: Image) -> Image:
        """h * x on the grid, as a new array."""
        self.fft.space[:] = image
        spectrum = self.fft.forward()
        spectrum *= self.otf
        return normalised(self.fft)

    def blur_adjoint(self, image: Image) -> Image:
        """The adjoint of `blur`: correlation with h, as a new array."""
        self.fft.space[:] = image
        spectrum = self.fft.forward()
        spectrum *= np.conj(self.otf)
        return normalised(self.fft)


def tight_model(calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
    """The model on the smallest grid without wrap-around."""
    psf = calibration.psfs[index]
    grid = Grid.tight(shape, n, field_radius_px(calibration), support_radius_px(psf))
    return Model(psf, grid, planner)


def periodic_model(calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
    """The model on the sensor's own pixels, as the paper has it."""
    return Model(calibration.psfs[index], Grid.periodic(shape, n, field_radius_px(calibration)), planner)


def otf(psf: Psf, grid: Grid) -> Spectrum:
    """The spectrum of a PSF seen through n x n pixels, zero displacement at the origin, 1 at frequency 0.

    The fine torus's low frequencies times the Dirichlet kernel of the block sum, which has no phase at a block's
    centre: a binned picture then stands exactly where the full one does. A PSF larger than the torus loses its margin.
    """
    n, (rows, cols) = grid.n, grid.shape
    fine = scipy_fft.rfft2(wrapped(psf, (rows * n, cols * n)).astype(np.float64))
    down = np.fft.fftfreq(rows, 1 / rows).astype(int)
    low = fine[down][:, : cols // 2 + 1]
    kernel = np.outer(dirichlet(np.fft.fftfreq(rows), n), dirichlet(np.fft.rfftfreq(cols), n))
    return np.asarray(low * kernel / low[0, 0].real, np.complex64)


def dirichlet(frequency: np.ndarray, n: int) -> np.ndarray:
    """The transfer of a mean over n pixels, at frequencies in cycles per sample of n pixels."""
    return np.asarray(np.sinc(frequency) / np.sinc(frequency / n))


def wrapped(psf: Psf, shape: Pair) -> Image:
    """The PSF on a torus of `shape` pixels with its centre at [0, 0]; what does not fit is its margin."""
    torus = np.zeros(shape, np.float32)
    source, target = [], []
    for have, want in zip(psf.shape, shape, strict=True):
        low, high = max(-(have // 2), -(want // 2)), min(have - have // 2, want - want // 2)
        source.append(slice(low + have // 2, high + have // 2))
        target.append(np.arange(low, high) % want)
    torus[np.ix_(*target)] = psf.pixels[tuple(source)]
    return torus


def normalised(fft: RealFft) -> Image:
    """The inverse transform of what is in the spectrum, divided by the number of samples, as a new array."""
    image: Image = fft.inverse() / np.float32(fft.shape[0] * fft.shape[1])
    return image


def field_box(calibration: Calibration, shape: Pair) -> tuple[slice, slice]:
    """The rows and columns of the sensor that hold the illuminated disc; all of it where the disc is not known."""
    return Grid.periodic(shape, 1, field_radius_px(calibration)).shown


def field_radius_px(calibration: Calibration) -> float:
    """Radius of the illuminated disc in sensor pixels; infinite where it is not known."""
    if calibration.field_deg is None or calibration.geometry is None:
        return float("inf")
    return calibration.field_deg * calibration.geometry.px_per_deg / 2


def taper(shape: Pair, share: float = 0.15) -> Image:
    """A cosine window that fades the outer `share` of the short side to nothing (Tukey), (rows, cols) float32."""
    width = max(1.0, share * min(shape))
    sides = []
    for size in shape:
        inward = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
        sides.append(0.5 - 0.5 * np.cos(np.pi * np.minimum(1, inward / width)))
    window: Image = np.outer(*sides).astype(np.float32)
    return window


def _box(mask: Image) -> tuple[int, int, int, int]:
    """Top, bottom, left, right of what the mask lets through."""
    rows, cols = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    return int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1


def _runs_past_the_edge(flat: Image) -> bool:
    """Whether a bright field would still be bright at the sensor's edge; a closed form then sees a false step."""
    border = np.concatenate([flat[0], flat[-1], flat[:, 0], flat[:, -1]])
    return bool(border.max() > 0.5 * flat.max())


def gradient_symbol(grid: Pair) -> tuple[Image, Image]:
    """|D|^2 of the periodic first difference, 4 - 2 cos - 2 cos: a row part (rows,) and a column part (cols//2+1,)."""
    rows = 2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(grid[0]))
    cols = 2 - 2 * np.cos(2 * np.pi * np.fft.rfftfreq(grid[1]))
    return rows.astype(np.float32), cols.astype(np.float32)
