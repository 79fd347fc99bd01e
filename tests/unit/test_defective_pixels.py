"""Detection of defective pixels: sensor defects are found, the sharpest image that the optics can form is not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from device.errors import FrameError
from device.recon.estimation.defective_pixels import DefectFinder, PixelNoise
from device.values import Calibration, Counts, Mask, Psf, Sensor

SHAPE = (160, 200)
BLACK_DN, WHITE_DN, GAIN = 64.0, 4095.0, 5.0
INNER = (slice(20, 140), slice(20, 180))


def caustic(margin_px: int = 0) -> Psf:
    """Return a PSF of bright lines about 3 pixels wide, like the finest lines of a caustic, that fade over a margin."""
    field = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((48, 48)), 3.0)
    away = np.hypot(*(np.mgrid[:48, :48] - 24))
    fade = 1.0 if margin_px == 0 else 0.5 - 0.5 * np.cos(np.pi * np.clip((23 - away) / margin_px, 0, 1))
    lines = np.exp(-((field / field.std()) ** 2) * 8) * fade
    return Psf(ndimage.gaussian_filter(lines, 1.4).astype(np.float32))


PSF = caustic()
CALIBRATION = Calibration(psfs=(PSF,), sensor=Sensor(BLACK_DN, GAIN, 2.0, WHITE_DN))


def frame(seed: int, peak_e: float = 10_000.0, points: int = 40) -> Counts:
    """Return counts of points and a smooth field through the PSF, with shot and read noise, 12 bits."""
    rng = np.random.default_rng(seed)
    scene = np.full(SHAPE, 1.0)
    scene[rng.integers(0, SHAPE[0], points), rng.integers(0, SHAPE[1], points)] += 200 * rng.random(points)
    light = ndimage.convolve(scene, PSF.pixels.astype(float), mode="constant")
    electrons = rng.poisson(light / light.max() * peak_e) + rng.normal(0, 2.0, SHAPE)
    return np.clip(np.round(electrons / GAIN + BLACK_DN), 0, WHITE_DN).astype(np.uint16)


def found(counts: Counts, calibration: Calibration = CALIBRATION) -> Mask:
    places = DefectFinder(calibration, SHAPE)(counts)
    mask = np.zeros(SHAPE, np.bool_)
    mask.ravel()[[] if places is None else places] = True
    return mask


@given(st.integers(0, 10_000), st.floats(200, 18_000))
def test_a_working_sensor_has_no_defects(seed: int, peak_e: float) -> None:
    """At most 4 of 32,000 pixels: of 1,100 frames with random seeds, one had three and one two."""
    assert found(frame(seed, peak_e)).sum() <= 4


@given(st.integers(0, 10_000), st.floats(14, 40))
def test_single_pixels_above_or_below_their_surroundings_are_found(seed: int, sd: float) -> None:
    rng = np.random.default_rng(seed)
    counts = frame(seed, points=0)
    at = rng.integers(25, 135, 12), rng.integers(25, 175, 12)
    noise_dn = np.sqrt((counts[at] - BLACK_DN) / GAIN + 1)
    off = np.where(np.arange(12) % 2, 1, -1) * (2 + sd) * noise_dn
    bad = counts.copy()
    bad[at] = np.clip(counts[at] + off, 0, WHITE_DN - 1)
    changed = np.abs(bad[at].astype(float) - counts[at]) > 15 * noise_dn  # 6 sd and twice the range of a noisy ring
    assert found(bad)[at][changed].all()


def square(mask: Mask) -> None:
    mask[60:90, 70:110] = True


def columns(mask: Mask) -> None:
    mask[:, 80:92] = True


def rows(mask: Mask) -> None:
    mask[70:76] = True


def blob(mask: Mask) -> None:
    """Mark a disc that is narrow along its border and wider than a narrow gap in its middle."""
    mask[np.hypot(*(np.mgrid[: SHAPE[0], : SHAPE[1]] - np.array([80, 100])[:, None, None])) < 22] = True


@pytest.mark.parametrize("value_dn", [0, int(BLACK_DN)])
@pytest.mark.parametrize("mark", [square, columns, rows, blob])
def test_a_gap_without_light_is_found_completely(mark: Callable[[Mask], None], value_dn: int) -> None:
    where = np.zeros(SHAPE, np.bool_)
    mark(where)
    counts = frame(1)
    counts[where] = value_dn
    mask = found(counts)
    assert mask[INNER][where[INNER]].all()
    assert mask[~where].sum() <= 0.02 * where.sum()  # beside a gap the rings have few pixels


def test_a_shadow_with_a_soft_edge_is_not_marked() -> None:
    rng = np.random.default_rng(3)
    light = np.full(SHAPE, 10_000.0)
    light[60:100, 70:130] = 0
    light = ndimage.gaussian_filter(light, 8.0)
    counts = np.clip(np.round(rng.poisson(light) / GAIN + BLACK_DN), 0, WHITE_DN).astype(np.uint16)
    assert found(counts).sum() <= 2


def test_the_surroundings_of_clipped_light_are_marked_and_those_of_a_hot_pixel_are_not() -> None:
    rows_px, cols_px = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = 30_000 * np.exp(-((rows_px - 80) ** 2 + (cols_px - 100) ** 2) / (2 * 15.0**2))
    electrons = np.random.default_rng(4).poisson(3_000 + spot)
    counts = np.clip(np.round(electrons / GAIN + BLACK_DN), 0, WHITE_DN).astype(np.uint16)
    counts[30, 30] = int(WHITE_DN)
    mask, full = found(counts), counts >= WHITE_DN
    assert mask[full].all()
    assert mask[ndimage.binary_dilation(full & (rows_px > 50), iterations=3)].mean() > 0.95
    assert mask[25:36, 25:36].sum() == 1


@pytest.mark.parametrize(("rows", "dark_rows"), [(80, None), (200, None), (160, 80)])
def test_a_frame_of_another_camera_mode_is_refused(rows: int, dark_rows: int | None) -> None:
    """Compiled code checks no bounds."""
    counts = np.full((rows, SHAPE[1]), 500, np.uint16)
    dark = None if dark_rows is None else np.full((dark_rows, SHAPE[1]), 64, np.uint16)
    with pytest.raises(FrameError, match=r"has .* pixels"):
        DefectFinder(CALIBRATION, SHAPE)(counts, dark)


def test_an_uncalibrated_black_level_marks_no_pixel() -> None:
    assert found(frame(5) - np.uint16(40)).sum() <= 2
    assert found(np.zeros(SHAPE, np.uint16)).sum() == 0


def test_the_image_of_a_point_has_no_defects() -> None:
    """The frame of one point is the PSF itself."""
    psf, light = caustic(margin_px=8), np.zeros(SHAPE)
    light[56:104, 76:124] = np.maximum(psf.pixels, 0) / psf.pixels.max() * 15_000
    counts = (np.random.default_rng(6).poisson(light) / GAIN + BLACK_DN).round().astype(np.uint16)
    assert found(counts, replace(CALIBRATION, psfs=(psf,))).sum() <= 8  # of 1800 lit pixels: shot noise on the lines


def test_one_pixel_that_stands_out_of_the_psf_hides_no_warm_pixels() -> None:
    """A hot pixel left in a measured PSF; by the largest excess of the PSF none of the warm pixels was found."""
    pixels, rng = PSF.pixels.copy(), np.random.default_rng(4)
    inner = np.zeros(pixels.shape, np.bool_)
    inner[4:-4, 4:-4] = pixels[4:-4, 4:-4] < 0.5 * pixels.max()
    flatness = ndimage.maximum_filter(pixels, 5) - ndimage.minimum_filter(pixels, 5)
    pixels.ravel()[np.where(inner, flatness, np.inf).argmin()] += 0.6 * pixels.max()
    calibration = replace(CALIBRATION, psfs=(Psf(pixels),))
    counts = frame(3)
    at = rng.integers(25, 135, 40), rng.integers(25, 175, 40)
    bad = counts.copy()
    bad[at] += np.uint16(500)  # the brightest pixel of the frame has 2077
    assert found(bad, calibration)[at].all()
    assert found(counts, calibration).sum() <= 4


@given(st.floats(0.02, 1.0), st.floats(1.0, 20.0))
def test_noise_is_measured_without_a_known_gain(per_dn: float, floor_dn2: float) -> None:
    rng = np.random.default_rng(7)
    light = np.tile(np.linspace(5, 3000, SHAPE[1]), (SHAPE[0], 1))
    counts = (light + rng.standard_normal(SHAPE) * np.sqrt(per_dn * light + floor_dn2)).astype(np.float32)
    measured = PixelNoise.measured(counts, np.zeros((1, SHAPE[1]), np.float32))
    assert measured.per_dn * 1500 + measured.floor_dn2 == pytest.approx(per_dn * 1500 + floor_dn2, rel=0.15)


def test_clipped_pixels_do_not_lower_the_measured_noise() -> None:
    counts = np.minimum(frame(8, peak_e=30_000, points=0), np.uint16(WHITE_DN))
    dark = np.full((1, SHAPE[1]), BLACK_DN, np.float32)
    assert (counts >= WHITE_DN).mean() > 0.3
    assert 0.7 / GAIN < PixelNoise.measured(counts, dark, WHITE_DN).per_dn < 1.5 / GAIN  # fine structure adds
