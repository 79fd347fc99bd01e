"""Where the edge of the illuminated field lies in a frame: how far off its place, and how much wider.

The field ends at a circle, the sharpest thing in every frame. The frame is correlated with what an even field would
give, at the frequencies of the caustic's speckle: the peak is where the picture lies, also if only the diffuser was
pushed aside behind its iris and all that is smooth stays where it was. Then, beside the smooth modes of `shading`, one
more stands for a circle that is a little wider; least squares tells it apart. A retina moves both by a few hundredths.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.recon.model import Model
from device.recon.plan import Spectrum
from device.recon.shading import BLOCK, blocks, modes
from device.values import Image

RIDGE = 1e-6
NARROW = 0.28  # samples by which the fit finds a field too narrow, at 20 um a sample as at 40: its rim is soft
LEAST_WEIGHT = 0.03  # of an even field's brightest place: where it is dark the read noise counts

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Edge:
    """How far the field's middle is off, in samples (down, right), and by which share the field is wider."""

    off: tuple[float, float]
    wider: float


class Rim:
    """A model whose field is known, ready to be seen through its OTF of the moment.

    `low` and `high` bound the frequencies of the speckle, in cycles per sample; `taper` fades the window.
    """

    def __init__(self, model: Model, low: float, high: float, taper: Image) -> None:
        self._model, self._taper = model, taper
        edge = [(np.roll(model.mask, 1, axis) - np.roll(model.mask, -1, axis)) / 2 for axis in (0, 1)]
        down, right = (
            (np.arange(size) - middle) / model.grid.radius_samples
            for size, middle in zip(model.grid.shape, model.grid.centre, strict=True)
        )
        outward = edge[0] * down[:, None] + edge[1] * right[None]
        each = (*modes(model), outward.astype(np.float32))
        self._spectra: list[Spectrum] = [scipy_fft.rfft2(np.asarray(mode)).astype(np.complex64) for mode in each]
        self._rows, self._cols = np.fft.fftfreq(model.grid.shape[0])[:, None], np.fft.rfftfreq(model.grid.shape[1])
        frequency = np.hypot(self._rows, self._cols)
        self._beyond = (frequency < low) | (frequency > high)

    def fit(self, y: Image, between: Callable[[], None]) -> Edge:
        """The edge that fits the window `y`, in DN; `between` is called after every mode."""
        off = self._place(y)
        turn = np.exp(-2j * np.pi * (self._rows * off[0] + self._cols * off[1])) * self._model.otf
        seen = [self._seen(spectrum * turn, between) for spectrum in self._spectra]
        seen.append(np.full_like(seen[0], seen[0].max()))  # stray light
        design = np.stack(seen)
        weights = 1 / (np.maximum(seen[0], 0) / seen[0].max() + LEAST_WEIGHT)
        normal = (design * weights) @ design.T
        normal[np.diag_indices_from(normal)] *= 1 + RIDGE
        found = np.linalg.solve(normal, (design * weights) @ blocks(y, BLOCK).ravel())
        outward = float(found[-2]) / max(float(found[0]), 1e-30)
        return Edge(off, (outward + NARROW) / self._model.grid.radius_samples)

    def _seen(self, spectrum: NDArray[np.complexfloating[Any, Any]], between: Callable[[], None]) -> Floats:
        between()
        image = scipy_fft.irfft2(spectrum, self._model.grid.shape)
        return blocks(image[self._model.grid.slices].astype(np.float32), BLOCK).ravel().astype(np.float64)

    def _place(self, y: Image) -> tuple[float, float]:
        """How far down and right the picture of the field lies, in samples: the peak, and a parabola through it."""
        grid = self._model.grid
        space = np.zeros(grid.shape, np.float32)
        space[grid.slices] = y * self._taper
        product = scipy_fft.rfft2(space) * np.conj(self._spectra[0] * self._model.otf)
        product[self._beyond] = 0
        match: Floats = scipy_fft.irfft2(product, grid.shape).astype(np.float64)
        at = np.unravel_index(int(np.argmax(match)), match.shape)
        rows, cols = match[:, at[1]], match[at[0]]
        return _vertex(rows, int(at[0])), _vertex(cols, int(at[1]))


def _vertex(line: Floats, at: int) -> float:
    """Where a periodic line is highest, around its highest sample; from minus to plus half its length."""
    left, middle, right = line[at - 1], line[at], line[(at + 1) % line.size]
    bend = left - 2 * middle + right
    place = at + (0.5 * float((left - right) / bend) if bend < 0 else 0.0)
    return place - line.size if place > line.size / 2 else place
