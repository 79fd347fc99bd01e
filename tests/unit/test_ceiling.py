"""Ceiling of an image: found from the order of its values alone, and only where sensor or converter ended."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from device.config.ceiling import ceiling_of
from device.config.image_files import as_companion, as_psf, as_raw, common_white_dn, psf_counts, saturated_share

SHAPE = (90, 120)
TOP = 4095.0


def light(seed: int, peak_dn: float) -> Any:
    """Return noisy 12-bit counts of a smooth scene, without an upper limit."""
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.standard_normal(SHAPE), 6)
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return np.round(rng.normal(64 + peak_dn * smooth, np.sqrt(9 + peak_dn * smooth / 4)))


MAPS: dict[str, Callable[[Any], Any]] = {
    "as it is": lambda counts: counts,
    "black level subtracted": lambda counts: (counts - counts.min()).astype(np.uint16),
    "whole numbers": lambda counts: (counts - counts.min() + 3).astype(np.int32),
    "float 0 to 1": lambda counts: (counts / TOP).astype(np.float32),
    "double": lambda counts: counts / 7,
    "gamma": lambda counts: (np.maximum(counts - counts.min(), 0) / TOP) ** 0.45,
    "left-justified": lambda counts: (counts - counts.min()).astype(np.uint16) << np.uint16(4),
    "negative": lambda counts: counts - 5000.0,
}


@pytest.mark.parametrize("name", MAPS)
@given(seed=st.integers(0, 10_000), peak_dn=st.floats(4600, 30_000), end_dn=st.sampled_from([TOP, 4080.0, 3839.0]))
@settings(max_examples=12, database=None)
def test_a_map_of_a_clipped_frame_that_keeps_values_distinct_has_the_same_mask(
    name: str, seed: int, peak_dn: float, end_dn: float
) -> None:
    counts = light(seed, peak_dn)
    assume((counts >= end_dn).mean() < 0.9)  # `load_raw` refuses a frame with more
    raw = as_raw(MAPS[name](np.minimum(counts, end_dn)))
    assert np.array_equal(raw.pixels >= raw.white_dn, counts >= end_dn)


@pytest.mark.parametrize("name", MAPS)
@given(seed=st.integers(0, 10_000), peak_dn=st.floats(5, 3500))
@settings(max_examples=12, database=None)
def test_a_map_of_a_frame_that_is_not_clipped_has_no_ceiling(name: str, seed: int, peak_dn: float) -> None:
    assert ceiling_of(MAPS[name](light(seed, peak_dn))) is None


def radius(scale_px: float) -> Any:
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.hypot(rows - SHAPE[0] // 2, cols - SHAPE[1] // 2) / scale_px


def noise(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


NOT_CLIPPED: dict[str, Callable[[], Any]] = {
    "constant": lambda: np.full(SHAPE, 7.0),
    "two levels": lambda: noise().integers(0, 2, SHAPE),
    "photon counts, mean 0.01": lambda: noise().poisson(0.01, SHAPE),
    "photon counts, mean 3": lambda: noise().poisson(3, SHAPE),
    "few grey levels": lambda: noise().poisson(200, SHAPE) // 16,
    "eight bits": lambda: (light(1, 3000) // 16).astype(np.uint8),
    "dark frame": lambda: np.round(noise().normal(64, 2, SHAPE)).astype(np.uint16),
    "quiet dark frame": lambda: np.round(noise().normal(64, 0.3, SHAPE)).astype(np.uint16),
    "dark frame, black level subtracted": lambda: np.maximum(np.round(noise().normal(0, 2, SHAPE)), 0),
    "hot pixels": lambda: light(2, 2000) + np.where(noise().random(SHAPE) < 5e-3, noise(1).random(SHAPE) * 900, 0),
    "one peak": lambda: np.exp(-(radius(5) ** 2)),
    "one pixel": lambda: (radius(1) == 0) * 1.0,
    "equal points": lambda: gaussian_filter((np.indices(SHAPE) % 15 == 7).all(axis=0) * 1000.0, 2),
    "smooth counts without noise": lambda: np.round(255 * np.exp(-(radius(40) ** 2))).astype(np.uint8),
    "flat top in whole numbers": lambda: np.round(3000 * gaussian_filter((radius(35) < 1) * 1.0, 5)),
    "flat top in floats": lambda: np.exp(-(radius(35) ** 8)),
    "flat frame of a formula": lambda: np.clip(1.3 - radius(60), 0, 1),
}


@pytest.mark.parametrize("name", NOT_CLIPPED)
def test_an_image_that_ends_by_itself_has_no_ceiling(name: str) -> None:
    assert ceiling_of(NOT_CLIPPED[name]()) is None


def test_each_channel_of_a_white_balance_has_its_own_ceiling() -> None:
    channels = [np.minimum(light(seed, peak), TOP) for seed, peak in ((1, 9000), (2, 2500), (3, 6000))]
    clipped = np.stack([channel == TOP for channel in channels], axis=-1)
    raw = as_raw(np.stack(channels, axis=-1) * np.array([1.0, 2.0, 0.6]))
    assert np.array_equal(raw.pixels >= raw.white_dn, clipped)


def test_raws_of_one_burst_share_the_ceiling_of_a_clipped_one() -> None:
    raws = [as_raw(np.minimum(light(seed, peak), 4080).astype(np.uint16)) for seed, peak in ((1, 900), (2, 9000))]
    assert common_white_dn(raws) == 4080
    assert common_white_dn(raws[:1]) == 1023  # of ten bits: no ceiling is known


def test_a_clipped_psf_is_saturated_whatever_its_ceiling() -> None:
    peaks = np.random.default_rng(4).normal(64 + 9000 * np.exp(-(radius(12) ** 2)), 5)
    for scale, end_dn in ((1, 4080.0), (1 / 4095, 1.0)):
        counts = np.minimum(peaks * scale, end_dn).astype(np.float32 if end_dn == 1 else np.uint16)
        assert saturated_share(as_psf(counts, "p"), psf_counts(counts, "p")) > 0.3


@pytest.mark.parametrize("scale", [1, 1 / 4095])
def test_saturated_pixels_of_a_dark_or_flat_frame_are_unknown(scale: float) -> None:
    counts = light(6, 8000)
    frame = np.minimum(counts, 4080) * scale
    frame = frame.astype(np.uint16 if scale == 1 else np.float32)
    unknown = np.isnan(as_companion(frame, "the flat frame"))
    assert np.array_equal(unknown, counts >= 4080)
    assert np.array_equal(as_companion(frame, "the flat frame")[~unknown], frame[~unknown])


def test_a_flat_frame_of_sums_beyond_16_bits_is_kept() -> None:
    sums = np.random.default_rng(0).integers(70_000, 90_000, SHAPE)
    assert np.array_equal(as_companion(sums, "the flat frame"), sums)
