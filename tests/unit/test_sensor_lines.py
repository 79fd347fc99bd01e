"""Faults of rows and columns: their noise is taken out of the counts, repeated and missing rows are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from device.errors import FrameError
from device.recon.estimation.line_noise import line_noise
from device.recon.estimation.sensor_lines import LineFinder, lines_of
from device.values import Image, Psf

SHAPE = 320, 400
BLACK_DN, WHITE_DN = 64.0, 4095.0
DARK = np.full((1, SHAPE[1]), BLACK_DN, np.float32)


def smooth(seed: int, sigma_px: float) -> Image:
    """Return smooth structure with the mean 1 and the standard deviation 0.2, (rows, cols)."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), sigma_px)
    return np.asarray(1 + 0.2 * noise / noise.std(), np.float32)


LIT = ndimage.gaussian_filter(
    (np.hypot(*np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 320))) < 0.9).astype(np.float32), 8
)
LIGHT_DN = {"disc": 800 * smooth(1, 4) * LIT, "full": 800 * smooth(2, 4)}
FINDER = LineFinder(DARK, WHITE_DN, Psf(np.maximum(smooth(3, 3), 0) * LIT, "green"))


def counts(light_dn: Image, seed: int = 7) -> np.ndarray:
    """Return counts with shot noise of 5 electrons per DN and read noise of 1 DN."""
    rng = np.random.default_rng(seed)
    noisy = BLACK_DN + rng.poisson(np.maximum(light_dn, 0) * 5) / 5 + rng.normal(0, 1, light_dn.shape)
    return np.clip(np.rint(noisy), 0, WHITE_DN).astype(np.uint16)


@pytest.mark.parametrize("scene", ["disc", "full"])
@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_a_clean_frame_is_returned_as_it_is(scene: str, seed: int) -> None:
    frame = counts(LIGHT_DN[scene], seed)
    found = FINDER(frame)
    assert found.counts is frame
    assert not found.figures


@pytest.mark.parametrize("scene", ["disc", "full"])
@pytest.mark.parametrize("axis", [0, 1])
@settings(max_examples=20)
@given(spread_dn=st.floats(4, 12), seed=st.integers(0, 1000))
def test_an_offset_of_lines_is_taken_out(scene: str, axis: int, spread_dn: float, seed: int) -> None:
    offset_dn = np.random.default_rng(seed).normal(0, spread_dn, SHAPE[1 - axis])
    frame = counts(LIGHT_DN[scene])
    found = FINDER((frame + np.expand_dims(offset_dn, axis)).astype(np.float32))
    assert list(found.figures) == [("column_noise_dn", "row_noise_dn")[axis]]
    left = (found.counts - frame.astype(np.float64)).mean(axis=axis)
    assert left.std() < 0.65 * spread_dn  # the slow part cannot be distinguished from the scene


@pytest.mark.parametrize("lit", [LIT, np.ones_like(LIT)])
@settings(max_examples=20)
@given(share=st.floats(0.02, 0.1), column=st.integers(120, 280), sign=st.sampled_from([-1, 1]))
def test_a_gain_step_is_taken_out_and_reported(lit: Image, share: float, column: int, sign: int) -> None:
    gain = np.where(np.arange(SHAPE[1]) < column, 1, 1 + sign * share)
    found = FINDER(counts(800 * smooth(1, 20) * lit * gain.astype(np.float32)))
    assert found.figures["gain_step"] == pytest.approx(share, abs=0.01)
    assert f"at column {column}" in found.notes[0]


@pytest.mark.parametrize("scene", ["disc", "full"])
def test_a_gain_of_lines_is_taken_out(scene: str) -> None:
    gain = 1 + 0.02 * np.random.default_rng(5).standard_normal(SHAPE[1])
    found = FINDER(counts(LIGHT_DN[scene] * gain.astype(np.float32)))
    middle = slice(150, 250)
    even = (found.counts - BLACK_DN)[100:220].mean(axis=0) / LIGHT_DN[scene][100:220].mean(axis=0)
    assert even[middle].std() < 0.5 * gain[middle].std()


def test_a_pattern_of_lines_in_the_object_stays() -> None:
    stripes = 1 + 0.2 * np.sin(2 * np.pi * np.arange(SHAPE[1]) / 25)
    frame = counts(LIGHT_DN["full"] * stripes.astype(np.float32))
    assert FINDER(frame).counts is frame
    noisy = (frame + np.random.default_rng(3).normal(0, 5, SHAPE[1])).astype(np.float32)
    left = FINDER(noisy).counts.mean(axis=0) - frame.mean(axis=0)
    wave = np.exp(2j * np.pi * np.arange(SHAPE[1]) / 25)
    assert abs((left * wave).mean()) < 0.03 * abs((frame.mean(axis=0) * wave).mean())


def test_saturated_pixels_and_dead_columns_keep_their_counts() -> None:
    frame = (counts(LIGHT_DN["full"]) + np.random.default_rng(3).normal(0, 8, SHAPE[1])).astype(np.float32)
    frame[50, 60], frame[:, 200] = WHITE_DN, 0
    found = FINDER(frame)
    assert found.counts[50, 60] == WHITE_DN
    assert np.abs(found.counts[:, 200]).max() < 30  # the light is 800


def test_channels_have_noise_of_their_own() -> None:
    frame = counts(LIGHT_DN["full"]).astype(np.float32)
    noise = np.random.default_rng(3).normal(0, 8, SHAPE[1]).astype(np.float32)
    found = FINDER(np.stack([frame, frame + noise, frame], -1))
    assert np.array_equal(found.counts[..., 0], frame)
    assert (found.counts[..., 1] - frame).mean(axis=0).std() < 4
    assert found.figures["column_noise_dn"] == pytest.approx(8, rel=0.3)


def test_few_lines_have_no_noise() -> None:
    assert line_noise(np.ones((16, 40), np.float32)) is None
    small = np.random.default_rng(1).integers(0, 900, (12, 300), dtype=np.uint16)
    assert LineFinder(DARK[:, :300], WHITE_DN, Psf(np.ones((12, 300), np.float32), "green"))(small).counts is small


def test_values_that_are_not_numbers_are_those_of_the_row_before() -> None:
    frame = counts(LIGHT_DN["full"]).astype(np.float32)
    gaps = frame.copy()
    gaps[100] = np.nan
    lines = lines_of(gaps)
    assert lines.unknown[100] == SHAPE[1]
    assert np.array_equal(lines.bins[100], lines_of(frame).bins[99])
    assert FINDER(gaps).counts is gaps


@pytest.mark.parametrize("scene", ["disc", "full"])
@pytest.mark.parametrize("count", [4, 16])
def test_a_block_of_repeated_rows_is_refused_by_name(scene: str, count: int) -> None:
    frame = counts(LIGHT_DN[scene])
    frame[150 : 150 + count] = frame[149]
    with pytest.raises(FrameError, match=f"rows 150 to {149 + count} repeat other rows"):
        FINDER(frame)


def test_repeated_rows_all_over_the_frame_are_refused() -> None:
    frame = counts(LIGHT_DN["full"])
    rows = np.arange(5, 320, 20)
    frame[rows] = frame[rows - 1]
    with pytest.raises(FrameError, match="16 rows repeat other rows of the frame; the first is row 5"):
        FINDER(frame)


def test_an_earlier_block_in_the_place_of_rows_is_refused() -> None:
    frame = counts(LIGHT_DN["full"])
    frame[200:212] = frame[100:112]
    with pytest.raises(FrameError, match="rows 200 to 211 repeat"):
        FINDER(frame)


def test_rows_that_are_read_twice_are_refused_in_spite_of_read_noise() -> None:
    frame = counts(LIGHT_DN["full"])
    frame[150:160] = np.rint(frame[149] + np.random.default_rng(2).normal(0, 2, (10, SHAPE[1])))
    with pytest.raises(FrameError, match="rows 150 to 159 repeat"):
        FINDER(frame)


def test_rows_of_a_scaled_file_and_dead_rows_are_no_repetition() -> None:
    scaled = np.repeat(counts(LIGHT_DN["full"])[:160], 2, axis=0)
    assert FINDER(scaled).counts is scaled
    dead = counts(LIGHT_DN["full"])
    dead[100:106] = 0
    assert FINDER(dead).counts is dead


@pytest.mark.parametrize("scene", ["disc", "full"])
@pytest.mark.parametrize("lost", [8, 14])
def test_missing_rows_are_refused_by_name(scene: str, lost: int) -> None:
    frame = counts(LIGHT_DN[scene])
    short = np.concatenate([frame[:140], frame[140 + lost :], np.zeros_like(frame[:lost])])
    with pytest.raises(FrameError, match=r"rows are missing or at a wrong place from row 1(39|40|41) on"):
        FINDER(short)


def test_a_step_of_the_gain_is_no_missing_row() -> None:
    light = LIGHT_DN["full"].copy()
    light[160:] *= 1.1
    assert FINDER(counts(light)).counts.dtype == np.uint16


def test_a_spot_and_a_reflex_are_no_missing_or_repeated_rows() -> None:
    rows, cols = np.indices(SHAPE)
    spot = np.hypot(rows - 160, cols - 150) < 20
    dark, bright = counts(LIGHT_DN["full"]), counts(LIGHT_DN["full"] + np.float32(500) * spot)
    dark[spot] = 0
    for frame in (dark, bright):
        assert FINDER(frame).counts is frame
