"""Uneven light: a gain over the sensor or light in its corners that no flat and no dark frame shows; NUMERICS.md 3.11.

Vignetting multiplies the frame by a smooth function of the place on the sensor, a leak adds light that falls off from a
corner. Behind a diffuser no object does either: each of its points lights a disc as wide as the PSF. Both are fitted
together with the shading of the disc, and the caller compares the misfits of the frame with and without them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.background import SensorPolynomial
from device.recon.estimation.noise import Noise
from device.recon.estimation.shading import RIDGE, STRAY_RIDGE, BlurredModes, block_means, blocks
from device.recon.model.grid import Grid
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Linear
from device.values import Image

SQUARE = 32  # side in samples of the squares whose means show uneven light
MIN_UNEVENNESS = 3.0  # clean frames up to 2.7, vignetting of 20 % at 500 electrons 3.2
FALLS = 0.5  # of the first unevenness: a correction leaves less
GAIN_DEGREE = 2  # of the polynomial: higher ones follow the retina's own shading
GAIN_STEPS = 4  # Gauss-Newton steps
PLANE = 1  # degree of the polynomial of light that rises over the sensor
MIN_FALLOFF = 0.05  # clean frames up to 0.03
MAX_FALLOFF = 0.7  # with more a part of the frame is dark, or its counts are not linear
LEAK_RIDGE = 1e-5
MIN_LEAK = 0.002  # of the mean light: less changes no picture
REACHES = (0.04, 0.08, 0.16, 0.32)  # of the sensor's width: exponential leak from a corner
SIGMAS = (0.05, 0.1, 0.2)  # the same of a Gaussian one
CORNERS = ("top left", "top right", "bottom left", "bottom right")
FALLOFF = (
    "The light falls off by {share:.0%} over the sensor, which the flat frame does not show; it was evened out. "
    "Measure the flat frame again."
)
LEAK = (
    "Light that is no image, {share:.1%} of the light, falls on the sensor, most near its {corner} corner; it was "
    "taken out. Look for a leak of light there."
)
Floats = NDArray[np.float64]


class UnevenLight(NamedTuple):
    """Uneven light of a frame on the samples of its window: the frame is `gain` times an image plus `added_dn`.

    `key` is its name in the report, `share` its size there, and `words` its message.
    """

    gain: Image
    added_dn: Image
    key: str
    share: float
    words: str

    def without(self, counts: Pixels, offset: Image, white_dn: float, grid: Grid) -> Image:
        """Return counts (rows, cols) as in even light, float32; saturated pixels keep their counts.

        `offset` is their dark frame, `grid` that of the window.
        """
        gain, added_dn = _on_sensor(self.gain, grid, 1.0), _on_sensor(self.added_dn, grid, 0.0)
        even = (counts - offset - added_dn) / gain + offset
        below = np.nextafter(np.float32(white_dn), np.float32(0))
        even = np.where(counts >= white_dn, np.float32(white_dn), np.minimum(even, below))
        return np.asarray(even, np.float32)


def unevenness(left_dn: Image, seen_dn: Image, noise: Noise) -> float:
    """Return the rms of the means of a residual (rows, cols) over SQUARE x SQUARE samples, in units of their noise.

    `seen_dn` is the light there. Below 1 for noise; 0 for a window that is smaller than a square.
    """
    if min(left_dn.shape) < SQUARE:
        return 0.0
    variance_dn2 = noise.per_dn * np.maximum(blocks(seen_dn, SQUARE), 0) + noise.floor_dn2
    squares = np.square(blocks(left_dn, SQUARE)) / np.maximum(variance_dn2, 1e-9)
    return float(squares.mean() ** 0.5 * SQUARE)


def find_uneven_light(frame: Linear, blurred: BlurredModes) -> list[UnevenLight]:
    """Return what may be uneven in the light of a frame, that which explains more of it first.

    `blurred` are the shading modes behind the frame's PSF.
    """
    found = (_falloff(frame, blurred), _leak(frame, blurred))
    return [light for _, light in sorted(found, key=lambda pair: pair[0]) if light is not None]


def _falloff(frame: Linear, blurred: BlurredModes) -> tuple[float, UnevenLight | None]:
    """Return what the fit with a gain leaves, and the gain: the exponential of a polynomial, which has no constant.

    None for too small or large a fall. Gauss-Newton steps in the coefficients of shading and logarithm of the gain.
    """
    share, means = block_means(frame, blurred.n)
    polynomial = SensorPolynomial(blurred.shape, blurred.n, GAIN_DEGREE)
    orders = polynomial.on_blocks[1:]
    seen = _with_constant(blurred)
    weights = blurred.weights * share
    ridges = np.concatenate([np.full(len(seen) - 1, RIDGE), [STRAY_RIDGE], np.full(len(orders), RIDGE)])
    log_gain = np.zeros(len(orders))
    light, left = _fitted(seen, means, weights, ridges[: len(seen)])
    for _ in range(GAIN_STEPS):
        gain = np.exp(log_gain @ orders).astype(np.float32)
        functions = np.concatenate([seen * gain, orders * (gain * (light @ seen))])
        coefficients, left = _fitted(functions, means, weights, ridges)
        light = coefficients[: len(seen)]
        log_gain = log_gain + coefficients[len(seen) :]
    gain = np.exp(polynomial.on_samples(np.concatenate([[0.0], log_gain]), frame.y.shape))
    fall = 1 - float(gain.min() / gain.max())
    if not MIN_FALLOFF < fall < MAX_FALLOFF:
        return left, None
    return left, UnevenLight(gain, np.zeros_like(gain), "falloff", fall, FALLOFF.format(share=fall))


def _leak(frame: Linear, blurred: BlurredModes) -> tuple[float, UnevenLight | None]:
    """Return what the fit with light in the corners leaves, and that light; None for light that changes no picture."""
    share, means = block_means(frame, blurred.n)
    seen = _with_constant(blurred)
    brightest = np.float32(seen[0].max())
    plane = SensorPolynomial(blurred.shape, blurred.n, PLANE)
    corners = _corners(blurred.shape, blurred.shape[1])
    functions = np.concatenate([seen, brightest * corners.reshape(len(corners), -1), brightest * plane.on_blocks[1:]])
    ridges = np.full(len(functions), LEAK_RIDGE)
    ridges[: len(seen)], ridges[len(seen) - 1] = RIDGE, STRAY_RIDGE
    coefficients, left = _fitted(functions, means, blurred.weights * share, ridges)
    of_corners, of_plane = np.split((coefficients[len(seen) :] * brightest).astype(np.float32), [len(corners)])
    added_dn = np.tensordot(of_corners, _corners(frame.y.shape, frame.y.shape[1]), 1)
    added_dn += plane.on_samples(np.concatenate([[0], of_plane]), frame.y.shape)
    added_dn -= added_dn.min()  # the solver has a constant of its own
    added_dn = np.asarray(added_dn, np.float32)
    leak = float(added_dn.mean() / frame.mean_dn) if frame.mean_dn > 0 else 0.0
    if leak < MIN_LEAK:
        return left, None
    words = LEAK.format(share=leak, corner=CORNERS[int(np.argmax(added_dn[[0, 0, -1, -1], [0, -1, 0, -1]]))])
    return left, UnevenLight(np.ones_like(added_dn), added_dn, "leak", leak, words)


def _with_constant(blurred: BlurredModes) -> Image:
    """Return the blurred modes and a constant on their scale, (modes + 1, blocks)."""
    return np.vstack([blurred.modes, np.full_like(blurred.modes[:1], blurred.modes[0].max())])


def _fitted(functions: Image, means: Image, weights: Image, ridges: Floats) -> tuple[Floats, float]:
    """Return the coefficients of a weighted ridge regression, and the weighted squares that it leaves."""
    weighted = functions * weights
    normal = np.asarray(weighted @ functions.T, np.float64)
    found = np.linalg.solve(normal + np.diag(ridges * np.diag(normal)), np.asarray(weighted @ means, np.float64))
    left = means - found @ functions
    return np.asarray(found, np.float64), float(weights @ (left * left))


def _corners(shape: tuple[int, int], width: float) -> Image:
    """Return light that falls off from each corner, in the order of CORNERS, (functions, values of `shape`)."""
    rows, cols = ((np.arange(size, dtype=np.float32) + 0.5) / np.float32(width) for size in shape)
    found = []
    for down in (rows, rows[::-1]):
        for right in (cols, cols[::-1]):
            away = np.hypot(down[:, None], right)
            found += [np.exp(-away / np.float32(reach)) for reach in REACHES]
            found += [np.exp(-(away**2) / np.float32(2 * sigma**2)) for sigma in SIGMAS]
    return np.stack(found)


def _on_sensor(image: Image, grid: Grid, outside: float) -> Image:
    """Return an image on the window as pixels of the sensor, `outside` beyond the window."""
    pixels = np.full(grid.sensor, outside, np.float32)
    block = np.repeat(np.repeat(image, grid.n, 0), grid.n, 1)
    top, left = grid.first_px
    pixels[top : top + block.shape[0], left : left + block.shape[1]] = block
    return pixels
