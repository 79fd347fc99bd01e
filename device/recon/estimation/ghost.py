"""Ghost: a second, weaker and displaced image, as of a beam splitter's second face; NUMERICS.md 3.12.

Its object reaches beyond the field on one side, where the forward model has none: that light stays in the residual. The
residual, deconvolved, therefore looks like the displaced object outside the field, for one displacement.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft

from device.recon.estimation.shading import blocks
from device.recon.estimation.uneven_light import UnevenLight
from device.recon.model.fft_plans import Spectrum
from device.recon.model.forward_model import Model
from device.recon.model.grid import Grid
from device.values import Image

REGULARISATION = np.float32(1e-3)  # of the deconvolved residual
EDGE_SAMPLES = 0.75  # beyond the field's edge that are left out
REACH = 1.6  # radii of the field, within which light of the ghost is searched for
NEAR = 5.0  # samples, at most, from the displacement found in means to that found in all samples
MAX_AWAY = 0.6  # field radii, of the displacement
MIN_OVERLAP = 1e-3  # of the largest denominator of `strength`: added to each of them
STRENGTH = 11.5  # a / (1 + a)^2 of a ghost over its strength in bright frames: 10 to 16; at 500 electrons 5 to 8
MAX_SEEN = 0.2  # of a share of 0.38
MIN_SCORE = 10.0  # clean frames have up to 4.6, ghosts of 5 % 16 to 23; the least share is corrections.MIN_GHOST
WORDS = (
    "A second image with {share:.0%} of the light, displaced by {right:+.0f} pixels to the right and {down:+.0f} down, "
    "was taken out. Look at the beam splitter: if it was turned or exchanged, measure the PSF again."
)
Shift = tuple[float, float]


class GhostTrace(NamedTuple):
    """What the residual of a picture shows of a ghost at each displacement.

    Attributes
    ----------
    strength
        Light outside the field over that of the object there, (rows, cols) of the displacements on the torus; in
        proportion to the ghost's share of the light, and several times smaller.
    score
        Likeness of both in units of the residual's rms.
    n
        n x n samples of the model are one value.
    """

    strength: Image
    score: Image
    n: int

    def strongest(self, near: Shift | None = None) -> Shift:
        """Return the displacement (down, right) of the highest score in samples, refined by a parabola on each axis.

        With `near` it is at most NEAR samples away from this one.
        """
        rows, cols = ((np.fft.fftfreq(size, 1 / size) * self.n) for size in self.score.shape)
        score = self.score
        if near is not None:
            score = np.where(np.hypot(rows[:, None] - near[0], cols - near[1]) <= NEAR, score, 0)
        at = np.unravel_index(int(np.argmax(score)), score.shape)
        moved = []
        for axis, (index, size) in enumerate(zip(at, self.score.shape, strict=True)):
            before, here, after = (float(np.roll(self.score, -step, axis)[at]) for step in (-1, 0, 1))
            bend = before - 2 * here + after
            away = 0.5 * (before - after) / bend if bend < 0 else 0.0
            moved.append(((int(index) + size // 2) % size - size // 2 + np.clip(away, -0.5, 0.5)) * self.n)
        return float(moved[0]), float(moved[1])

    def strength_at(self, shift: Shift) -> float:
        """Return the strength at a displacement (down, right) in samples."""
        rows, cols = self.strength.shape
        return float(self.strength[round(shift[0] / self.n) % rows, round(shift[1] / self.n) % cols])


def share_of(strength: float) -> float:
    """Return the share of a ghost in the light of the first image, about, from the strength of its trace.

    The strength of a share a is a / (1 + a)^2 / STRENGTH.
    """
    seen = min(STRENGTH * strength, MAX_SEEN)
    return float((1 - 2 * seen - (1 - 4 * seen) ** 0.5) / (2 * seen))


class Ghost(NamedTuple):
    """Ghost in a frame: its displacement (down, right) in samples, and the light of the frame in DN on the torus,
    predicted beyond the window.
    """

    shift: Shift
    light: Image

    def removal(self, share: float, grid: Grid) -> UnevenLight:
        """Return the light of the ghost if it has this share of the first image's, and what keeps shot noise.

        Without the ghost light falls to 1 / (1 + share), and the variance of noise rises to 1 / (1 - share^2): the
        rest times 1 - share has the shot noise of its light.
        """
        rows, cols = self.light.shape
        turn = np.fft.fftfreq(rows)[:, None] * self.shift[0] + np.fft.rfftfreq(cols) * self.shift[1]
        single = fft.irfft2(fft.rfft2(self.light) / (1 + share * np.exp(-2j * np.pi * turn)), (rows, cols))
        added_dn = np.asarray((self.light - (1 - share) * single)[grid.slices], np.float32)
        down, right = (grid.n * away for away in self.shift)
        words = WORDS.format(share=share, right=right, down=down)
        return UnevenLight(np.ones_like(added_dn), added_dn, "ghost", share, words)


def find_ghost(trace: GhostTrace, left: Image, picture: Image, light: Image, model: Model) -> Ghost | None:
    """Return the ghost of a trace, or None.

    Parameters
    ----------
    trace
        Its trace, of values of any size.
    left
        Residual in DN, (rows, cols) of the window, 0 for missing samples.
    picture
        Picture whose residual it is, (rows, cols) of the torus.
    light
        The picture behind the PSF in DN, (rows, cols) of the torus.
    model
        Model of the picture.
    """
    if trace.score.max() < MIN_SCORE:
        return None
    seen = light.copy()
    seen[model.grid.slices] += left
    return Ghost(ghost_trace(left, picture, model, 1).strongest(near=trace.strongest()), seen)


def ghost_trace(left: Image, picture: Image, model: Model, n: int) -> GhostTrace:
    """Return what a residual shows of a ghost, with n x n samples as one value; the others as for `find_ghost`."""
    grid = model.grid
    shape = rows, cols = grid.shape[0] // n, grid.shape[1] // n
    residual = np.zeros(shape, np.float32)
    means = blocks(left, n)
    residual[: means.shape[0], : means.shape[1]] = means
    seen = blocks(np.roll(picture, (-grid.at[0], -grid.at[1]), (0, 1)), n)  # both from the window's corner on
    otf: Spectrum = model.otf[np.fft.fftfreq(rows, 1 / rows).astype(int)][:, : cols // 2 + 1]
    spectrum = fft.rfft2(residual) * np.conj(otf) / (np.abs(otf) ** 2 + REGULARISATION)
    outside = _outside(grid, shape, n)
    found = fft.irfft2(spectrum, shape) * outside
    both = fft.irfft2(fft.rfft2(found) * np.conj(fft.rfft2(seen)), shape)
    own = np.maximum(fft.irfft2(fft.rfft2(outside) * np.conj(fft.rfft2(seen * seen)), shape), 0)
    own += MIN_OVERLAP * own.max()
    away = np.hypot(np.fft.fftfreq(rows, 1 / rows)[:, None], np.fft.fftfreq(cols, 1 / cols))
    near = (away > 0) & (away < MAX_AWAY * grid.radius_samples / n)
    rms = float(np.sqrt(np.vdot(found, found) / max(float(outside.sum()), 1.0)))
    score = np.where(near, both / np.maximum(np.sqrt(own) * rms, 1e-30), 0)
    return GhostTrace(np.asarray(both / np.maximum(own, 1e-30), np.float32), np.asarray(score, np.float32), n)


@lru_cache(maxsize=4)
def _outside(grid: Grid, shape: tuple[int, int], n: int) -> Image:
    """Return 1 in the ring around the field in which light of a ghost may be, else 0, from the window's corner on."""
    radius = grid.radius_samples / n
    rows, cols = (
        (np.arange(size) - (middle - at - (n - 1) / 2) / n + size / 2) % size - size / 2
        for size, middle, at in zip(shape, grid.centre, grid.at, strict=True)
    )
    away = np.hypot(rows[:, None], cols)
    return np.asarray((away > radius + EDGE_SAMPLES) & (away < REACH * radius), np.float32)
