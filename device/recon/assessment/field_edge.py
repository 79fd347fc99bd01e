"""Field edge: displacement and radius of the lit field in a frame, compared with the calibrated field.

The displacement is the peak of the correlation of the frame with the frame of an even field, at the frequencies of the
caustic's fine structure. It is therefore also found if the diffuser moved behind its iris but the smooth part of the
light did not. The radius comes from a least-squares fit of the smooth modes of `shading` and one more mode, the
derivative of the field with respect to its radius.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.recon.estimation.shading import BLOCK, blocks, modes
from device.recon.model.fft_plans import Spectrum
from device.recon.model.forward_model import Model
from device.values import Image

RIDGE = 1e-6
NARROW = 0.28  # samples by which the fit underestimates the radius, at 20 and at 40 um a sample: the field edge is soft
MIN_WEIGHT = 0.03  # of the maximum of an even field, added for the read noise

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FieldEdge:
    """Displacement of the field's centre in samples (down, right), and the relative excess of its radius."""

    offset_samples: tuple[float, float]
    radius_change_ratio: float


class FieldEdgeFit:
    """Fit of displacement and radius of the field for one model with a known field, with the model's present OTF.

    `low` and `high` limit the frequencies of the correlation, in cycles per sample; `taper` is the window function. The
    modes are computed for each fit: their spectra would take 18 MB for a fit now and then.
    """

    def __init__(self, model: Model, low: float, high: float, taper: Image) -> None:
        self._model, self._taper = model, taper
        edge = [(np.roll(model.mask, 1, axis) - np.roll(model.mask, -1, axis)) / 2 for axis in (0, 1)]
        down, right = (
            (np.arange(size) - middle) / model.grid.radius_samples
            for size, middle in zip(model.grid.shape, model.grid.centre, strict=True)
        )
        self._outward: Image = (edge[0] * down[:, None] + edge[1] * right[None]).astype(np.float32)
        self._rows = np.fft.fftfreq(model.grid.shape[0])[:, None]
        self._cols = np.fft.rfftfreq(model.grid.shape[1])
        frequency = np.hypot(self._rows, self._cols)
        self._beyond = (frequency < low) | (frequency > high)

    def fit(self, y: Image, between: Callable[[], None]) -> FieldEdge:
        """Return displacement and radius of the field in the window `y` (DN); `between` is called before every mode."""
        off = self._displacement(y)
        turn = np.exp(-2j * np.pi * (self._rows * off[0] + self._cols * off[1])).astype(np.complex64) * self._model.otf
        seen = [self._seen(mode, turn, between) for mode in chain(modes(self._model), (self._outward,))]
        seen.append(np.full_like(seen[0], seen[0].max()))  # stray light
        design = np.stack(seen)
        weights = 1 / (np.maximum(seen[0], 0) / seen[0].max() + MIN_WEIGHT)
        normal = (design * weights) @ design.T
        normal[np.diag_indices_from(normal)] *= 1 + RIDGE
        found = np.linalg.solve(normal, (design * weights) @ blocks(y, BLOCK).ravel())
        outward = float(found[-2]) / max(float(found[0]), 1e-30)
        return FieldEdge(off, (outward + NARROW) / self._model.grid.radius_samples)

    def _seen(self, mode: Image, turn: Spectrum, between: Callable[[], None]) -> Floats:
        between()
        image: Image = scipy_fft.irfft2(scipy_fft.rfft2(mode) * turn, self._model.grid.shape)
        return blocks(image[self._model.grid.slices], BLOCK).ravel().astype(np.float64)

    def _displacement(self, y: Image) -> tuple[float, float]:
        """Return the displacement (down, right) in samples: the correlation peak, refined by a parabola."""
        grid = self._model.grid
        space = np.zeros(grid.shape, np.float32)
        space[grid.slices] = y * self._taper
        product = scipy_fft.rfft2(space) * np.conj(scipy_fft.rfft2(self._model.mask) * self._model.otf)
        product[self._beyond] = 0
        match: Floats = scipy_fft.irfft2(product, grid.shape).astype(np.float64)
        at = np.unravel_index(int(np.argmax(match)), match.shape)
        rows = match[:, at[1]]
        cols = match[at[0]]
        return _vertex(rows, int(at[0])), _vertex(cols, int(at[1]))


def _vertex(line: Floats, at: int) -> float:
    """Return the position of a periodic line's maximum around its sample `at`, from minus to plus half its length."""
    left = line[at - 1]
    middle = line[at]
    right = line[(at + 1) % line.size]
    curvature = left - 2 * middle + right
    place = at + (0.5 * float((left - right) / curvature) if curvature < 0 else 0.0)
    return place - line.size if place > line.size / 2 else place
