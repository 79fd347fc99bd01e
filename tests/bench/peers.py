"""Other solvers on the same frame and pixels with the same judge: for the benchmark only, not shipped."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import fft, ndimage
from skimage.restoration import wiener

from device.clock import SystemClock
from device.recon.assessment.metrics import PictureScorer
from device.recon.model.fft_plans import Planner
from device.recon.model.grid import Grid
from device.recon.model.resampling import to_sensor
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.scene_files import SimulatedExposure
from device.values import Image
from tests.bench import timing
from tests.bench.candidates import candidates
from tests.bench.peer_environment import lensless_pictures
from tests.bench.scoring import judge_of, scored

N = 2
Convolve = Callable[[Image], Image]


def binned(image: Image, n: int = N) -> Image:
    rows, cols = (size // n for size in image.shape)
    return image[: rows * n, : cols * n].reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float32)


def centred(psf: Image, n: int = N) -> Image:
    """Return the PSF shifted by a fraction of a pixel to the centre of a block, so that no peer loses half a pixel."""
    half = (n - 1) / 2
    return np.asarray(fft.ifft2(ndimage.fourier_shift(fft.fft2(psf), (half, half))).real, np.float32)


def blurs(psf: Image) -> tuple[Convolve, Convolve, float]:
    """Return periodic h * x, its adjoint, and the largest |H|^2."""
    otf = fft.rfft2(np.fft.ifftshift(psf / psf.sum()))
    shape = psf.shape
    forward = lambda x: fft.irfft2(fft.rfft2(x) * otf, shape)  # noqa: E731
    adjoint = lambda x: fft.irfft2(fft.rfft2(x) * otf.conj(), shape)  # noqa: E731
    return forward, adjoint, float(np.abs(otf).max() ** 2)


def fista(y: Image, psf: Image, rounds: int) -> Image:
    """Accelerated projected gradient with non-negativity (Beck and Teboulle 2009); two FFT pairs per round."""
    forward, adjoint, lipschitz = blurs(psf)
    x = z = np.full_like(y, max(float(y.mean()), 0))
    t = 1.0
    for _ in range(rounds):
        new = np.maximum(z - adjoint(forward(z) - y) / lipschitz, 0).astype(np.float32)
        t, before = (1 + (1 + 4 * t * t) ** 0.5) / 2, t
        x, z = new, new + np.float32((before - 1) / t) * (new - x)
    return x


def richardson_lucy(y: Image, psf: Image, rounds: int) -> Image:
    """Multiplicative rounds for Poisson noise (Richardson 1972, Lucy 1974); two FFT pairs per round."""
    forward, adjoint, _ = blurs(np.maximum(psf, 0))
    y = np.maximum(y, 0)
    x = np.full_like(y, max(float(y.mean()), 1e-6))
    for _ in range(rounds):
        x = (x * adjoint(y / np.maximum(forward(x), 1e-6))).astype(np.float32)
    return np.maximum(x, 0)


def skimage_wiener(y: Image, psf: Image, _: int) -> Image:
    """scikit-image's Wiener filter with its default prior, at the balance of its example, on [0, 1]."""
    return np.asarray(wiener(y / y.max(), psf, balance=1e-3, clip=False), np.float32)


PEERS: tuple[tuple[str, Callable[[Image, Image, int], Image], tuple[int, ...]], ...] = (
    ("scikit-image restoration.wiener", skimage_wiener, (1,)),
    ("FISTA, non-negative", fista, (10, 50, 150)),
    ("Richardson-Lucy", richardson_lucy, (10, 50, 150)),
)
LENSLESS_ROUNDS = (10, 40, 100)


def peers(scene: SimulatedExposure, planner: Planner) -> None:
    """Print our solvers and others in one table.

    The others run at bin 2 on black-subtracted counts, without shading model and crop model.
    """
    shape = (scene.truth.shape[0], scene.truth.shape[1])
    judge = judge_of(scene)
    timing.head("peers, 1080 x 1920 binned by 2 (medians of 3)", "ms", "peak MB", "PSNR dB", "PCC", "SSIM", "detail")
    for recipe in (Recipe("gradient", N), Recipe("evidence", N), Recipe("variation", N)):
        planned = partial(Reconstructor, scene.calibration, shape, planner, SystemClock(), (recipe,), refract=False)
        make = planned()
        (ms,) = timing.side_by_side_ms(partial(make, scene.counts), rounds=3)
        mb = timing.peak_mb(lambda planned=planned: planned()(scene.counts))
        scored(f"ours: {recipe.method}", ms, mb, judge, make(scene.counts).picture)
    candidates(scene, N, planner)
    y = binned(scene.counts.astype(np.float32) - np.float32(scene.calibration.sensor.black_dn))
    psf = binned(centred(scene.calibration.psfs[0].pixels)) * N**2
    grid = Grid.periodic(shape, N, float("inf"))
    for name, solve, some in PEERS:
        for rounds in some:
            repeats = 3 if rounds <= 10 else 1
            begin = time.perf_counter()
            for _ in range(repeats):
                picture = solve(y, psf, rounds)
            ms = (time.perf_counter() - begin) / repeats * 1e3
            mb = timing.peak_mb(partial(solve, y, psf, 1))
            scored(f"{name}{f', {rounds} rounds' if rounds > 1 else ''}", ms, mb, judge, to_sensor(picture, grid))
    lensless(y, psf, grid, judge)


def lensless(y: Image, psf: Image, grid: Grid, judge: PictureScorer) -> None:
    """Print the rows of LenslessPiCam's ADMM, run in its own environment."""
    for name, ms, mb, picture in lensless_pictures(y, psf, LENSLESS_ROUNDS):
        scored(name, ms, mb, judge, to_sensor(picture, grid))
