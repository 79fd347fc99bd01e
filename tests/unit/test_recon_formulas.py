"""Estimators and solver steps of the reconstruction against the formulas of NUMERICS.md, on small arrays."""

from math import log

import numpy as np
import pytest

from device.recon.assessment import quality_figures
from device.recon.assessment.psf_consistency import sparsity
from device.recon.estimation.parameter_selection import MU_CANDIDATES, FrequencySample, cross_validated
from device.recon.estimation.power_law_prior import BINS, PowerLaw, PowerLawPrior
from device.recon.estimation.psf_selection import negative_log_likelihood
from device.recon.methods import METHODS
from device.recon.model.forward_model import Model, periodic_model
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resolution import working_bin
from device.recon.solvers.tv import TotalVariation
from device.values import Psf, Sensor
from tests import scenes
from tests.textbook import deconvolution as textbook

SIDE = 96


@pytest.fixture(scope="module")
def model() -> Model:
    return periodic_model(scenes.calibration(scenes.speckle((SIDE, SIDE))), (SIDE, SIDE), 1, scenes.PLANNER, 0)


def test_generalised_cross_validation_is_the_minimum_of_its_formula() -> None:
    """NUMERICS.md 3.4."""
    rng = np.random.default_rng(1)
    power, prior, delta = rng.exponential(1e-3, 500), rng.uniform(0.1, 4, 500), rng.exponential(1e-6, 500)
    energies = rng.exponential(power / prior + 1e-4)
    regs = MU_CANDIDATES[:, None] * prior + delta
    phi = regs / (power + regs)
    scores = energies.size * (phi**2 * energies).sum(axis=1) / phi.sum(axis=1) ** 2
    assert 0 < scores.argmin() < scores.size - 1
    mu, score = cross_validated(power, prior, delta, energies)
    assert mu == MU_CANDIDATES[scores.argmin()]
    assert score == pytest.approx(scores.min(), rel=1e-6)


def test_the_stopband_gives_the_variance_of_white_noise(model: Model) -> None:
    """NUMERICS.md 2.2: the median of an exponential law is ln 2 times its mean; 1000 frequencies, three sd are 14 %."""
    model.fft.space[:] = np.random.default_rng(2).normal(0, 3, (SIDE, SIDE))
    sample = FrequencySample.of(model)
    found = sample.noise_variance(sample.energies(model.fft.forward()), model.grid.size)
    assert found == pytest.approx(9, rel=0.14)


def test_the_fitted_power_law_is_at_least_as_likely_as_the_true_one(model: Model) -> None:
    """NUMERICS.md 3.6: S = |H|^2 g + s2, E = sum of log S + |Y|^2 / S."""
    rng, prior, truth, s2 = np.random.default_rng(3), PowerLawPrior(model), PowerLaw(4.0, 2.2), 0.01

    def spectrum_of(law: PowerLaw) -> np.ndarray:
        return np.asarray(prior.power * np.exp(law.log_power - law.slope * prior.logs) + s2)

    def unlikelihood(law: PowerLaw) -> float:
        return float((np.log(spectrum_of(law)) + seen / spectrum_of(law)).sum())

    seen = rng.exponential(spectrum_of(truth))
    y = np.zeros(model.otf.shape, np.complex64)
    y.ravel()[prior.where] = np.sqrt(seen)
    found = prior.fit(y, s2).law
    assert unlikelihood(found) <= unlikelihood(truth)
    assert found.slope == pytest.approx(truth.slope, abs=0.2)
    assert found.log_power == pytest.approx(truth.log_power, abs=0.2)
    reg = prior.regularisation(found, s2).ravel()[prior.where]
    assert reg == pytest.approx(s2 / np.exp(found.log_power - found.slope * prior.logs), rel=1e-4)


def test_the_psf_likelihood_has_the_best_amplitude(model: Model) -> None:
    """NUMERICS.md 7.3: the least of log A + mean log S + mean |Y|^2 / (A S), which ends in 1, over A and q."""
    sample = FrequencySample.of(model)
    s = sample.power / (sample.gradient + 1e-3)
    energies = np.random.default_rng(4).exponential(50 * (s + 1e-4))
    a = np.geomspace(1, 1e3, 400)
    values = [np.log(a) + np.log(s + q).mean() + (energies / (s + q)).mean() / a - 1 for q in MU_CANDIDATES]
    assert negative_log_likelihood(sample, energies) == pytest.approx(np.min(values), abs=1e-4)


@pytest.mark.parametrize(("sigma_px", "n"), [(1.5, 1), (2.2, 2), (3.0, 3), (5.0, 5)])
def test_the_working_bin_samples_the_passband(sigma_px: float, n: int) -> None:
    """NUMERICS.md 1.3: a Gaussian PSF falls to 0.001 of |H|^2 at sqrt(ln 1000) / (2 pi sigma) cycles per pixel."""
    x = np.arange(128) - 64
    blob = np.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * sigma_px**2)).astype(np.float32)
    assert working_bin(Psf(blob)) == n == int(0.5 // (np.sqrt(log(1000)) / (2 * np.pi * sigma_px)))


def test_banding_is_the_rms_of_the_row_means_beyond_the_noise() -> None:
    """NUMERICS.md 8.1: noise alone gives 0, bands of 1 % of the light give 0.01 / sqrt(2)."""
    noise_dn, light_dn, rows, cols = 20.0, 1000.0, 200, 400
    left = np.random.default_rng(5).normal(0, noise_dn, (rows, cols)).astype(np.float32)
    bands = 0.01 * light_dn * np.sin(np.arange(rows) / 3)[:, None].astype(np.float32)
    assert quality_figures.banding(left, noise_dn**2, light_dn) == 0
    assert quality_figures.banding(left + bands, noise_dn**2, light_dn) == pytest.approx(0.01 / 2**0.5, rel=0.1)


@pytest.mark.parametrize("lit", [1.0, 0.5])
def test_the_coverage_is_the_lit_share_of_the_field_also_in_noise(lit: float) -> None:
    """Noise as large as the light; half the field lit is off by the edge of the surroundings: a fortieth of it."""
    down, right = np.mgrid[-100:100, -100:100]
    mask = (np.hypot(down, right) < 90).astype(np.float32)
    light = mask * (right >= 0 if lit < 1 else 1)
    noisy = np.maximum(light + np.random.default_rng(0).normal(0, 1, light.shape) * light, 0).astype(np.float32)
    for picture in (light, noisy):
        assert quality_figures.coverage(picture, mask, 0.0) == pytest.approx(lit, abs=0.04)


def test_the_coverage_of_a_field_without_samples_is_zero() -> None:
    assert quality_figures.coverage(np.ones((8, 8), np.float32), np.zeros((8, 8), np.float32), 0.0) == 0


def test_the_cutoff_is_the_frequency_of_equal_signal_and_noise(model: Model) -> None:
    """NUMERICS.md 8.1: the first ring whose mean of |H|^2 g / s2 is below 1, and its half-period on the retina."""
    prior, law, s2 = PowerLawPrior(model), PowerLaw(3.0, 2.0), 0.02
    snr = prior.power * np.exp(law.log_power - law.slope * prior.logs) / s2
    below = [b for b in range(BINS) if snr[prior.bins == b].mean() < 1]
    edges = np.geomspace(prior.low, prior.high, BINS + 1)
    limit = quality_figures.cutoff(prior, law, s2, 2, scenes.GEOMETRY)
    assert 0 < below[0] < BINS
    assert limit.cycles_per_px == pytest.approx(edges[below[0]] / 2)
    assert limit.half_period_um == pytest.approx(0.5 / (limit.cycles_per_px * scenes.GEOMETRY.px_per_deg) * 296.7)


def test_the_sparsity_of_one_edge_follows_from_the_share_of_its_samples() -> None:
    """NUMERICS.md 8.2: if a share p of the samples holds the whole gradient, S = p log(1 + 1 / p)."""
    image, p = np.zeros((40, 100), np.float32), 1 / 99
    image[:, 50:] = 7
    assert sparsity(image) == pytest.approx(p * log(1 + 1 / p), rel=1e-5)
    assert sparsity(np.random.default_rng(7).normal(0, 1, (40, 100)).astype(np.float32)) > 10 * sparsity(image)


def test_rounds_of_total_variation_are_those_of_the_textbook() -> None:
    """NUMERICS.md 4.2, on a cropped field with dead columns; single against double precision."""
    shape = (64, 80)
    calibration = scenes.calibration(
        scenes.speckle((64, 64)),
        sensor=Sensor(gain_e_per_dn=2.0, read_noise_e=3.0),
        geometry=scenes.GEOMETRY,
        field_deg=14.0,
        bad=np.arange(80)[None] * np.ones((64, 1), int) == 30,
    )
    method = METHODS["variation"]
    model = method.model(calibration, shape, 1, scenes.PLANNER, 0)
    solver = method.build(model, calibration, scenes.PLANNER)
    assert isinstance(solver, TotalVariation)
    scene = model.mask * np.random.default_rng(8).uniform(500, 1500, model.grid.shape).astype(np.float32)
    seen = np.random.default_rng(9).poisson(np.maximum(2 * model.blur(scene)[model.grid.slices], 0)) / 2
    counts = np.zeros(shape, np.float32)
    rows, cols = (slice(at, at + size) for at, size in zip(model.grid.first_px, model.grid.window, strict=True))
    counts[rows, cols] = seen
    frame = Preprocessor(calibration, model.grid)(counts)
    solver.start(frame)
    noise, at = solver.detail.noise, model.grid.slices
    y, W = np.zeros(model.grid.shape), np.zeros(model.grid.shape)
    y[at] = frame.y - solver.stray
    W[at] = frame.good / (noise.per_dn * np.maximum(solver.blurred[at], 0) + noise.floor_dn2)
    H = np.fft.fft2(np.fft.irfft2(model.otf.astype(np.complex128), model.grid.shape))
    slow = textbook.total_variation(
        solver.x.astype(float), y, W, H, model.mask.astype(float), solver.tau, solver.rho, solver.stiffness, 3
    )
    for _ in range(3):
        solver.step()
    assert np.linalg.norm(solver.x - slow) <= 1e-4 * np.linalg.norm(slow)
    assert np.linalg.norm(np.diff(slow)) > 0.01 * np.linalg.norm(slow)
