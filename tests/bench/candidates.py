"""Rejected solvers, each with the same start, grid and judge as ours.

gradients   crop-aware preconditioned conjugate gradients with the evidence prior (NUMERICS.md 4.4)
wavelets    empirical Wiener shrinkage of an undecimated wavelet transform, after the Wiener filter (ForWaRD-like)
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.recon.model.preprocessing import Linear, Preprocessor
from device.recon.model.resampling import to_sensor
from device.recon.solvers.tv import EvidenceWiener
from device.sim.scene_files import SimulatedExposure
from device.values import Image
from tests.bench import timing
from tests.bench.scoring import judge_of, scored

SEEN = 0.7  # share of the torus: weight of the data term in the preconditioner
SPLINE = np.array([1, 4, 6, 4, 1], np.float32) / 16  # B3 spline of the à trous transform
SCALES, STRENGTH = 4, 1.0


@dataclass
class Start:
    """Common start on one frame: shading, residual, and the filter selected by the evidence."""

    solver: EvidenceWiener
    frame: Linear
    smooth: Image
    left: Image

    @classmethod
    def of(cls, scene: SimulatedExposure, n: int, planner: Planner) -> "Start":
        shape = scene.counts.shape[0], scene.counts.shape[1]
        method = METHODS["evidence"]
        model = method.model(scene.calibration, shape, n, planner, 0)
        solver = method.build(model, scene.calibration, planner)
        assert isinstance(solver, EvidenceWiener)
        return cls(solver, Preprocessor(scene.calibration, model.grid)(scene.counts), *np.zeros((2, 1, 1), np.float32))

    def begin(self) -> None:
        solver, model = self.solver, self.solver.model
        solver.start(self.frame)
        self.smooth = np.zeros(model.grid.shape, np.float32)
        _, stray = solver.shading.fit(self.frame, self.smooth)
        self.left = (self.frame.y - self.forward(self.smooth) - np.float32(stray)) * self.frame.good

    def forward(self, x: Image) -> Image:
        """Return crop(h * x)."""
        model = self.solver.model
        return fft.irfft2(fft.rfft2(x) * model.otf, model.grid.shape)[model.grid.slices]

    def adjoint(self, y: Image) -> Image:
        """Return the adjoint, inside the field."""
        model = self.solver.model
        whole = np.zeros(model.grid.shape, np.float32)
        whole[model.grid.slices] = y
        return fft.irfft2(fft.rfft2(whole) * model.otf.conj(), model.grid.shape) * model.mask

    def picture(self, detail: Image) -> Image:
        return np.maximum((self.smooth + detail) * self.solver.model.mask, 0).astype(np.float32)


def gradients(start: Start, rounds: int) -> Image:
    """Solve (M H'C'CHM + R) z = M H'C' r, started from the Wiener solution; three FFT pairs per round."""
    start.begin()
    model, reg = start.solver.model, start.solver.detail.reg
    shape, mask = model.grid.shape, model.mask
    condition = 1 / (SEEN * np.abs(model.otf) ** 2 + reg + np.float32(1e-7))

    def apply(z: Image) -> Image:
        prior = fft.irfft2(fft.rfft2(z) * reg, shape)
        return start.adjoint(start.forward(z * mask) * start.frame.good) + mask * prior

    z = (start.solver.x - start.smooth) * mask
    r = start.adjoint(start.left) - apply(z)
    s = mask * fft.irfft2(fft.rfft2(r) * condition, shape)
    p, rs = s, float(np.vdot(r, s))
    for _ in range(rounds):
        q = apply(p)
        alpha = np.float32(rs / float(np.vdot(p, q)))
        z, r = z + alpha * p, r - alpha * q
        s = mask * fft.irfft2(fft.rfft2(r) * condition, shape)
        rs, before = float(np.vdot(r, s)), rs
        p = s + np.float32(rs / before) * p
    return start.picture(z)


def wavelets(start: Start, _: int) -> Image:
    """Shrink each scale by the filtered noise there, estimated from one noise realisation."""
    start.begin()
    model, solver = start.solver.model, start.solver
    noise = np.zeros(model.grid.shape, np.float32)
    draw = np.random.default_rng(0).standard_normal(model.grid.window, np.float32)
    noise[model.grid.slices] = draw * np.float32(solver.detail.noise.variance_dn2(solver.level) ** 0.5)
    gain = model.otf.conj() / (np.abs(model.otf) ** 2 + solver.detail.reg)
    noise = fft.irfft2(fft.rfft2(noise) * gain, model.grid.shape)
    coarse, hiss = (solver.x - start.smooth) * model.mask, noise
    detail = np.zeros_like(coarse)
    for scale in range(SCALES):
        smoother, hush = spread(coarse, scale), spread(hiss, scale)
        wave, floor = coarse - smoother, STRENGTH * float((hiss - hush).var())
        power = ndimage.uniform_filter(wave**2, 5)
        detail += wave * np.maximum(1 - floor / np.maximum(power, 1e-20), 0)
        coarse, hiss = smoother, hush
    return start.picture(detail + coarse)


def spread(image: Image, scale: int) -> Image:
    """Return one step of the à trous transform: the spline with holes of 2^scale."""
    taps = np.zeros(4 * 2**scale + 1, np.float32)
    taps[:: 2**scale] = SPLINE
    return ndimage.convolve1d(ndimage.convolve1d(image, taps, 0), taps, 1)


CANDIDATES: tuple[tuple[str, Callable[[Start, int], Image], tuple[int, ...]], ...] = (
    ("conjugate gradients, evidence prior", gradients, (5, 10, 20)),
    ("wavelet shrinkage after `evidence`", wavelets, (1,)),
)


def candidates(scene: SimulatedExposure, n: int, planner: Planner) -> None:
    """Print their rows of the table of peers; counts prepared, the start included."""
    start, judge = Start.of(scene, n, planner), judge_of(scene)
    for name, solve, some in CANDIDATES:
        for rounds in some:
            solve(start, rounds)
            begin = time.perf_counter()
            picture = solve(start, rounds)
            ms = (time.perf_counter() - begin) * 1e3
            grid = start.solver.model.grid
            mb = timing.peak_mb(lambda solve=solve: solve(Start.of(scene, n, planner), 1))
            scored(f"{name}{f', {rounds} rounds' if rounds > 1 else ''}", ms, mb, judge, to_sensor(picture, grid))
