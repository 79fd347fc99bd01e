"""Registration of the frames of a burst, or of colours: the shift of each picture from a reference, sub-pixel.

Pictures of several gaze directions are registered by `masked_correlation.py`.

The lit field does not move with the eye, so that raw frames correlate at shift 0. Each picture is therefore divided by
its local mean, windowed inside the field, band-passed and correlated; the peak is refined with a matrix DFT (Guizar-
Sicairos, Thurman, Fienup, Opt. Lett. 33, 156, 2008). NUMERICS.md 9.1 has the figures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from device.values import Image

BAND_PER_PX = (0.004, 0.12)  # cycles per sensor pixel: vessels and background texture, without shading and noise
FLATTEN_PX = 25.0  # sigma of the local mean, in sensor pixels
RIM_PX, WINDOW_PX = 14.0, 40.0  # the window is 0 within RIM_PX of the field's edge and rises over WINDOW_PX
MIN_LEVEL = 0.05  # of the mean level: below it a picture has no detail to divide by
REACH = 0.5  # largest shift as a share of the shorter side of the picture
STEPS_SAMPLES = (0.25, 0.05, 0.01)  # of the search around the peak

Complexes = NDArray[np.complex64]
Floats = NDArray[np.float64]
Shift = tuple[float, float]


@dataclass(frozen=True)
class Registration:
    """Shift of a picture from a reference and their normalised correlation at that shift, -1 to 1.

    What is at (r, c) of the reference stands at (r, c) + `shift_px` in the picture, in sensor pixels. `sd` is the
    standard deviation of the correlation over all shifts: what pictures that have nothing in common reach by chance.
    """

    shift_px: Shift
    correlation: float
    sd: float


@dataclass(frozen=True)
class Detail:
    """Band-passed spectrum of a flattened picture, of unit energy; the zero spectrum for a picture without detail."""

    spectrum: Complexes


class Registrar:
    """Registration of pictures (rows, cols) of one grid, `n` x `n` sensor pixels per sample.

    `field` is the lit field, (rows, cols) in 0..1, soft-edged; all ones if it is unknown. `flatten_px` is the sigma of
    the local mean and `band_per_px` the band of the correlation, in sensor pixels.
    """

    def __init__(
        self, field: Image, n: int, flatten_px: float = FLATTEN_PX, band_per_px: tuple[float, float] = BAND_PER_PX
    ) -> None:
        self._n = n
        self._sigma = flatten_px / n
        padded = np.pad(field, 1)  # the picture ends at its border, where an unknown field has no edge
        depth = np.asarray(ndimage.distance_transform_edt(padded > 0.5), np.float32)[1:-1, 1:-1] * n
        rise = np.clip((depth - RIM_PX) / WINDOW_PX, 0, 1)
        self._window = (rise * rise * (3 - 2 * rise)).astype(np.float32)
        self._inside = (depth > RIM_PX / 2).astype(np.float32)
        self._weight = np.maximum(ndimage.gaussian_filter(self._inside, self._sigma), 0.05)
        self._shape = tuple(fft.next_fast_len(round((1 + REACH) * size), real=True) for size in field.shape)
        rows = np.fft.fftfreq(self._shape[0])
        cols = np.fft.rfftfreq(self._shape[1])
        radius = np.hypot(rows[:, None], cols[None]) / n
        band = (radius > band_per_px[0]) & (radius < band_per_px[1])
        self._band = band.astype(np.float32)
        self._box = np.ix_(band.any(axis=1), band.any(axis=0))  # outside it every detail is 0
        self._rows = rows[band.any(axis=1)]
        self._cols = cols[band.any(axis=0)]

    def flat(self, picture: Image) -> Image:
        """Return a linear picture (rows, cols) divided by its local mean, minus 1; 0 outside the field."""
        lit = picture * self._inside
        level = float(lit.sum(dtype=np.float64) / max(self._inside.sum(), 1))
        if not level > 0:
            return np.zeros_like(lit)
        local = ndimage.gaussian_filter(lit, self._sigma) / self._weight
        return np.asarray((lit / np.maximum(local, MIN_LEVEL * level) - 1) * self._inside, np.float32)

    def detail(self, flat: Image, shift_px: Shift = (0.0, 0.0)) -> Detail:
        """Return the detail of a flat picture, moved back by `shift_px` and windowed to what both fields hold."""
        moved, window = self.moved_back(flat, shift_px)
        return self.windowed(moved, window)

    def moved_back(self, flat: Image, shift_px: Shift) -> tuple[Image, Image]:
        """Return a flat picture moved back by `shift_px`, and the window of what it and the reference hold."""
        if shift_px == (0.0, 0.0):
            return flat, self._window
        back = [-shift / self._n for shift in shift_px]
        window = np.minimum(self._window, ndimage.shift(self._window, back, order=1, mode="constant"))
        return ndimage.shift(flat, back, order=3, mode="constant"), window

    def windowed(self, flat: Image, window: Image) -> Detail:
        """Return the detail of a flat picture within a window, (rows, cols) in 0..1."""
        return Detail(self._unit(fft.rfft2(flat * window, self._shape) * self._band))

    def mean(self, details: Sequence[Detail]) -> Detail:
        """Return the mean of details of unit energy."""
        return Detail(self._unit(np.sum([detail.spectrum for detail in details], axis=0)))

    def register(self, reference: Detail, moved: Detail) -> Registration:
        """Return the shift of `moved` from `reference`, at most REACH of the shorter side, and their correlation."""
        cross = np.conj(reference.spectrum) * moved.spectrum
        surface = fft.irfft2(cross, self._shape, norm="forward")
        reach = [int(REACH * min(self._shape) / (1 + REACH))] * 2
        around = np.roll(surface, reach, axis=(0, 1))[: 2 * reach[0] + 1, : 2 * reach[1] + 1]
        row, col = np.unravel_index(int(around.argmax()), around.shape)
        best = (float(row - reach[0]), float(col - reach[1]))
        peak = float(around.max())
        inside = np.ascontiguousarray(cross[self._box])
        for step in STEPS_SAMPLES:
            best, peak = self._refined(inside, best, step)
        return Registration((best[0] * self._n, best[1] * self._n), peak, float(around.std()))

    def rest(self, reference: Detail, moved: Detail, found: Registration) -> Detail:
        """Return the detail of `moved` that the displaced reference does not explain, of unit energy."""
        row, col = (shift / self._n for shift in found.shift_px)
        turn = np.exp(-2j * np.pi * (self._rows[:, None] * row + self._cols[None] * col))
        spectrum = moved.spectrum.copy()
        spectrum[self._box] -= (found.correlation * turn * reference.spectrum[self._box]).astype(np.complex64)
        return Detail(self._unit(spectrum))

    def _refined(self, cross: Complexes, near: Shift, step: float) -> tuple[Shift, float]:
        """Return the place and height of the highest correlation on a 9 x 9 lattice of `step` samples around `near`.

        `cross` is the cross spectrum at the frequencies of the band's box.
        """
        rows = near[0] + step * np.arange(-4, 5)
        cols = near[1] + step * np.arange(-4, 5)
        half = np.where(self._cols == 0, 1, 2)  # the rfft leaves out the conjugate half
        by_row = np.exp(2j * np.pi * rows[:, None] * self._rows[None]).astype(np.complex64)
        by_col = np.exp(2j * np.pi * self._cols[:, None] * cols[None]) * half[:, None]
        values = (by_row @ cross @ by_col).real
        row, col = np.unravel_index(int(values.argmax()), values.shape)
        return (float(rows[row]), float(cols[col])), float(values.max())

    def _unit(self, spectrum: NDArray[np.complexfloating]) -> Complexes:
        """Return the spectrum scaled so that the correlation of a picture with itself is 1."""
        half = np.where(np.arange(spectrum.shape[1]) == 0, 1.0, 2.0)
        energy = float((np.abs(spectrum) ** 2 * half).sum())
        return np.asarray(spectrum / np.sqrt(energy) if energy > 0 else spectrum, np.complex64)
