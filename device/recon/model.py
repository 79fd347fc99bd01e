"""The model that every solver shares: y = crop(h * x) + b, with x inside the field, on one planned grid."""

import numpy as np

from device.recon.plan import Planner, RealFft, Spectrum
from device.values import Calibration, Image, Psf


def disc(shape: tuple[int, int], centre: tuple[float, float], radius_px: float) -> Image:
    """A disc with a one-pixel soft rim, (rows, cols) float32 in 0..1; an infinite radius fills everything."""
    if not np.isfinite(radius_px):
        return np.ones(shape, np.float32)
    rows = (np.arange(shape[0], dtype=np.float32) - np.float32(centre[0]))[:, None]
    cols = (np.arange(shape[1], dtype=np.float32) - np.float32(centre[1]))[None, :]
    rim: Image = np.clip(radius_px + 0.5 - np.hypot(rows, cols), 0, 1, dtype=np.float32)
    return rim


def wrapped(psf: Psf, n: int, shape: tuple[int, int]) -> Image:
    """The PSF on a torus of `shape` pixels, each n x n of the sensor's, zero displacement at [0, 0], unit sum.

    Binning is a box filter of width n sampled every n pixels, centred on zero displacement also for even n (its two
    outermost taps then count half), so that a binned picture stands exactly where the full one does. A PSF larger than
    the torus loses its margin, not its centre.
    """
    fine = np.zeros((shape[0] * n, shape[1] * n), np.float32)
    source, target = [], []
    for have, want in zip(psf.shape, fine.shape, strict=True):
        low, high = max(-(have // 2), -(want // 2)), min(have - have // 2, want - want // 2)
        source.append(slice(low + have // 2, high + have // 2))
        target.append(np.arange(low, high) % want)
    fine[np.ix_(*target)] = psf.pixels[tuple(source)]
    for axis in (0, 1):
        taps = range(-(n // 2), n // 2 + 1)
        ends = 0.5 if n % 2 == 0 else 1.0
        fine = sum(np.roll(fine, -d, axis) * (ends if abs(d) == n // 2 and n > 1 else 1.0) for d in taps)  # type: ignore[assignment]
        fine = fine[::n] if axis == 0 else fine[:, ::n]
    return np.asarray(fine / fine.sum(dtype=np.float64), np.float32)


class Model:
    """One PSF on one grid: its planned FFT, its OTF, the field, and the field as the sensor would see it.

    `shape` is the sensor's (rows, cols); `bin` n sums n x n pixels to one; the grid is periodic with
    (rows//n, cols//n) samples. `flat` is crop(h * mask): what an evenly bright field would give.
    """

    def __init__(self, calibration: Calibration, shape: tuple[int, int], n: int, planner: Planner, index: int) -> None:
        self.bin = n
        self.grid = (shape[0] // n, shape[1] // n)
        self.fft: RealFft = planner.plan(self.grid)
        centre = tuple(((size - 1) / 2 - (n - 1) / 2) / n for size in shape)
        self.mask = disc(self.grid, (centre[0], centre[1]), field_radius_px(calibration) / n)
        self.box = self._box()
        self.fft.space[:] = wrapped(calibration.psfs[index], n, self.grid)
        self.otf: Spectrum = self.fft.forward().copy()
        self.flat = self.blur(self.mask)
        self.window = taper(self.grid) if _runs_past_the_edge(self.flat) else None
        self.row_gradient, self.col_gradient = gradient_symbol(self.grid)

    def _box(self) -> tuple[int, int, int, int]:
        """Top, bottom, left, right of what the mask lets through."""
        rows, cols = np.nonzero(self.mask.any(axis=1))[0], np.nonzero(self.mask.any(axis=0))[0]
        return int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1

    @property
    def size(self) -> int:
        """Samples of the grid."""
        return self.grid[0] * self.grid[1]

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


def normalised(fft: RealFft) -> Image:
    """The inverse transform of what is in the spectrum, divided by the number of samples, as a new array."""
    image: Image = fft.inverse() / np.float32(fft.shape[0] * fft.shape[1])
    return image


def field_box(calibration: Calibration, shape: tuple[int, int], n: int = 1) -> tuple[slice, slice]:
    """The rows and columns, in n x n bins, that hold the illuminated disc; the whole sensor where it is not known."""
    radius_px = field_radius_px(calibration) + 4
    if radius_px == float("inf"):
        return slice(None), slice(None)
    spans = [(max(0.0, (size - 1) / 2 - radius_px), min(size, (size + 1) / 2 + radius_px)) for size in shape]
    rows, cols = (slice(round(low / n), max(round(high / n), round(low / n) + 1)) for low, high in spans)
    return rows, cols


def field_radius_px(calibration: Calibration) -> float:
    """Radius of the illuminated disc in sensor pixels; infinite where it is not known."""
    if calibration.field_deg is None or calibration.geometry is None:
        return float("inf")
    return calibration.field_deg * calibration.geometry.px_per_deg / 2


def taper(grid: tuple[int, int], share: float = 0.15) -> Image:
    """A cosine window that fades the outer `share` of the short side to nothing (Tukey), (rows, cols) float32."""
    width = max(1.0, share * min(grid))
    sides = []
    for size in grid:
        inward = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
        sides.append(0.5 - 0.5 * np.cos(np.pi * np.minimum(1, inward / width)))
    window: Image = np.outer(*sides).astype(np.float32)
    return window


def _runs_past_the_edge(flat: Image) -> bool:
    """Whether a bright field would still be bright at the sensor's edge; a periodic model then sees a false step."""
    border = np.concatenate([flat[0], flat[-1], flat[:, 0], flat[:, -1]])
    return bool(border.max() > 0.5 * flat.max())


def gradient_symbol(grid: tuple[int, int]) -> tuple[Image, Image]:
    """|D|^2 of the periodic first difference, 4 - 2 cos - 2 cos: a row part (rows,) and a column part (cols//2+1,)."""
    rows = 2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(grid[0]))
    cols = 2 - 2 * np.cos(2 * np.pi * np.fft.rfftfreq(grid[1]))
    return rows.astype(np.float32), cols.astype(np.float32)
