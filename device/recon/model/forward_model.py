"""Forward model of every solver: y = crop(h * x) + b, on one planned grid.

h is the PSF, x the object (zero outside the field), b a constant background. `Model.blur` and `Model.blur_adjoint` are
the convolution and its adjoint, by FFT.
"""

import numpy as np
from scipy import fft as scipy_fft

from device.recon.model.fft_plans import Planner, RealFft, Spectrum
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import Grid, Pair, support_radius_px
from device.values import Calibration, Image, Psf

ROWS = 64  # of a PSF that are transformed at a time: all at once would take 36 MB for a moment


class Model:
    """Forward model of one PSF on one grid: planned FFT, OTF, field mask, and the blurred field on the sensor.

    `flat` (the window's shape) is crop(h * mask), the frame of an evenly bright field. `fade` is a taper of
    the window for light that extends past the sensor's edge; None if it does not. `stored` is the OTF as
    calibrated, `otf` the one in use. `box` is (top, bottom, left, right) of the field mask; both gradients
    are those of `gradient_symbol`.

    Parameters
    ----------
    psf
        PSF, centred at (rows//2, cols//2).
    grid
        Grid of the model.
    planner
        Planner of the FFTs.
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
        """Replace the OTF by that of a scaled PSF on the same grid, and recompute `flat` and `fade` (one FFT pair).

        Parameters
        ----------
        otf
            OTF, complex64 (rows, cols//2 + 1) of the grid.
        """
        self.otf = otf
        self.flat = np.ascontiguousarray(self.blur(self.mask)[self.grid.slices])
        self.fade = taper(self.grid.window) if _extends_past_edge(self.flat) else None

    def blur(self, image: Image) -> Image:
        """Return h * x on the grid.

        Parameters
        ----------
        image
            Object x, float32 of the shape of the grid.

        Returns
        -------
        Image
            New array, float32 of the same shape.
        """
        self.fft.space[:] = image
        spectrum = self.fft.forward()
        spectrum *= self.otf
        return normalised(self.fft)

    def blur_adjoint(self, image: Image) -> Image:
        """Return the adjoint of `blur`, the correlation with h.

        Parameters
        ----------
        image
            Float32 of the shape of the grid.

        Returns
        -------
        Image
            New array, float32 of the same shape.
        """
        self.fft.space[:] = image
        spectrum = self.fft.forward()
        spectrum *= np.conj(self.otf)
        return normalised(self.fft)


def tight_model(calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
    """Return the model on the smallest grid without wrap-around, with n x n pixels per sample and PSF `index`."""
    psf = calibration.psfs[index]
    grid = Grid.tight(shape, n, field_radius_px(calibration), support_radius_px(psf))
    return Model(psf, grid, planner)


def periodic_model(calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
    """Return the model on the periodic grid of the sensor's own size, as in the paper."""
    return Model(calibration.psfs[index], Grid.periodic(shape, n, field_radius_px(calibration)), planner)


def otf(psf: Psf, grid: Grid) -> Spectrum:
    """Return the OTF of a PSF on a grid: complex64 (rows, cols//2 + 1), without displacement, 1 at frequency 0.

    It is the low-frequency part of the full-resolution spectrum times the Dirichlet kernel of the block mean. That
    kernel has no phase at a block's centre, so a binned picture is not shifted. A PSF larger than the grid loses its
    margin.
    """
    n = grid.n
    (rows, cols) = grid.shape
    torus = wrapped(psf, (rows * n, cols * n))
    fine = np.empty((rows * n, cols // 2 + 1), np.complex128)  # low frequencies along the columns, all along the rows
    for begin in range(0, rows * n, ROWS):
        part = slice(begin, begin + ROWS)
        fine[part] = scipy_fft.rfft(torus[part].astype(np.float64))[:, : cols // 2 + 1]
    down = np.fft.fftfreq(rows, 1 / rows).astype(int)
    low = scipy_fft.fft(fine, axis=0, overwrite_x=True)[down]
    kernel = np.outer(dirichlet(np.fft.fftfreq(rows), n), dirichlet(np.fft.rfftfreq(cols), n))
    return np.asarray(low * kernel / low[0, 0].real, np.complex64)


def dirichlet(frequency: np.ndarray, n: int) -> np.ndarray:
    """Return the transfer factor of a mean over n pixels at `frequency`, in cycles per sample of n pixels."""
    return np.asarray(np.sinc(frequency) / np.sinc(frequency / n))


def wrapped(psf: Psf, shape: Pair) -> Image:
    """Return the PSF on a torus of `shape` pixels with its centre at [0, 0]; a larger PSF loses its margin."""
    torus = np.zeros(shape, np.float32)
    source = []
    target = []
    for have, want in zip(psf.shape, shape, strict=True):
        low = max(-(have // 2), -(want // 2))
        high = min(have - have // 2, want - want // 2)
        source.append(slice(low + have // 2, high + have // 2))
        target.append(np.arange(low, high) % want)
    torus[np.ix_(*target)] = psf.pixels[tuple(source)]
    return torus


def normalised(fft: RealFft) -> Image:
    """Return the inverse transform of `fft.spectrum`, divided by the number of samples, as a new array."""
    image: Image = fft.inverse() / np.float32(fft.shape[0] * fft.shape[1])
    return image


def taper(shape: Pair, share: float = 0.15) -> Image:
    """Return a Tukey window, (rows, cols) float32: it falls to 0 at each edge over `share` of the shorter side."""
    width = max(1.0, share * min(shape))
    sides = []
    for size in shape:
        inward = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
        sides.append(0.5 - 0.5 * np.cos(np.pi * np.minimum(1, inward / width)))
    window: Image = np.outer(*sides).astype(np.float32)
    return window


def _box(mask: Image) -> tuple[int, int, int, int]:
    """Return top, bottom, left, right of the nonzero part of the mask; bottom and right are exclusive."""
    rows = np.nonzero(mask.any(axis=1))[0]
    cols = np.nonzero(mask.any(axis=0))[0]
    return int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1


def _extends_past_edge(flat: Image) -> bool:
    """Return True if `flat` exceeds half its maximum at the sensor's edge: a periodic FFT then adds a false step."""
    border = np.concatenate([flat[0], flat[-1], flat[:, 0], flat[:, -1]])
    return bool(border.max() > 0.5 * flat.max())


def gradient_symbol(grid: Pair) -> tuple[Image, Image]:
    """Return |D|^2 of the periodic first difference in two parts whose sum it is: 2 - 2 cos per axis, float32.

    The row part is (rows,), the column part (cols//2 + 1,), in the order of the rfft of `grid` (rows, cols).
    """
    rows = 2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(grid[0]))
    cols = 2 - 2 * np.cos(2 * np.pi * np.fft.rfftfreq(grid[1]))
    return rows.astype(np.float32), cols.astype(np.float32)
