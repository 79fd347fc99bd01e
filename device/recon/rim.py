"""Where the edge of the illuminated field lies in a frame: how far off its place, and how much wider.

The field is smooth inside and ends at a circle. Beside the smooth modes of `shading`, three more stand for a circle
that is a little lower, further right, or wider: the sensor sees all of them through the blur, and least squares tells
them apart. A retina's bright disc would pull a centroid by half a degree; an edge it moves by a few hundredths.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft as scipy_fft

from device.recon.model import Model
from device.recon.plan import Spectrum
from device.recon.shading import BLOCK, blocks, modes
from device.values import Image

RIDGE = 1e-6
NARROW = 0.28  # samples by which the fit finds a field too narrow, at 20 um a sample as at 40: its rim is soft
LEAST_WEIGHT = 0.03  # of an even field's brightest place: where it is dark the read noise counts


@dataclass(frozen=True)
class Edge:
    """How far the field's middle is off, in samples (down, right), and by which share the field is wider."""

    off: tuple[float, float]
    wider: float


class Rim:
    """The modes of a model whose field is known, ready to be seen through its OTF of the moment."""

    def __init__(self, model: Model) -> None:
        self._model = model
        edge = [(np.roll(model.mask, 1, axis) - np.roll(model.mask, -1, axis)) / 2 for axis in (0, 1)]
        down, right = (
            (np.arange(size) - middle) / model.grid.radius_samples
            for size, middle in zip(model.grid.shape, model.grid.centre, strict=True)
        )
        outward = edge[0] * down[:, None] + edge[1] * right[None]
        each = (*modes(model), *edge, outward.astype(np.float32))
        self._spectra: list[Spectrum] = [scipy_fft.rfft2(np.asarray(mode)).astype(np.complex64) for mode in each]

    def fit(self, y: Image, between: Callable[[], None]) -> Edge:
        """The edge that fits the window `y`, in DN; `between` is called after every mode."""
        seen = [self._seen(spectrum, between) for spectrum in self._spectra]
        seen.append(np.full_like(seen[0], seen[0].max()))  # stray light
        design = np.stack(seen)
        weights = 1 / (np.maximum(seen[0], 0) / seen[0].max() + LEAST_WEIGHT)
        normal = (design * weights) @ design.T
        normal[np.diag_indices_from(normal)] *= 1 + RIDGE
        found = np.linalg.solve(normal, (design * weights) @ blocks(y, BLOCK).ravel())
        down, right, outward = found[-4:-1] / max(float(found[0]), 1e-30)
        return Edge((float(down), float(right)), (float(outward) + NARROW) / self._model.grid.radius_samples)

    def _seen(self, spectrum: Spectrum, between: Callable[[], None]) -> np.ndarray:
        between()
        image = scipy_fft.irfft2(spectrum * self._model.otf, self._model.grid.shape)
        return blocks(image[self._model.grid.slices], BLOCK).ravel().astype(np.float64)
