"""Bursts: shifts, rejected frames and gain of joined frames of a moving retina behind a field that stands still."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.clock import SystemClock
from device.errors import FrameError
from device.recon.burst import BurstJoiner, JoinedFrame
from device.recon.estimation.registration import Registrar
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import lit_field
from device.recon.model.grid import Grid, disc
from device.recon.model.resampling import moved_back
from device.recon.reconstructor import Reconstructor
from device.values import Calibration, Counts, Image, Reconstruction
from tests.moving_retina import (
    BLACK_DN,
    DRIFT_PX,
    FIELD_PX,
    OTHER_RETINA,
    RETINA,
    SHAPE,
    burst_calibration,
    field,
    frame,
    seen,
)

PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return burst_calibration()


@pytest.fixture(scope="module")
def join(calibration: Calibration) -> BurstJoiner:
    return BurstJoiner(calibration, SHAPE, PLANNER, SystemClock())


def psnr_db(picture: Image, truth: Image) -> float:
    """Return the PSNR inside the common part of all frames, after the best scale and offset."""
    inside = disc(SHAPE, ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2), FIELD_PX / 2 - 16) > 0.5
    columns = np.stack([picture[inside], np.ones(inside.sum())], axis=1)
    error = columns @ np.linalg.lstsq(columns, truth[inside], rcond=None)[0] - truth[inside]
    return float(10 * np.log10(truth[inside].max() ** 2 / (error**2).mean()))


def solved(calibration: Calibration, counts: np.ndarray) -> Image:
    return Reconstructor(calibration, SHAPE, PLANNER, SystemClock(), refract=False, timed=False)(counts).picture


def solved_burst(calibration: Calibration, first: Counts, joined: JoinedFrame) -> Image:
    """Return the picture of a joined frame in DN of one exposure, solved as the sum that it stands for."""
    solver = Reconstructor(calibration, SHAPE, PLANNER, SystemClock(), refract=False, timed=False)
    *_, made = solver.steps(first, joined=joined.counts * np.float32(joined.light))
    assert isinstance(made, Reconstruction)
    return made.picture / np.float32(joined.light)


def test_four_moving_frames_gain_as_a_longer_exposure_and_their_shifts_are_found(
    calibration: Calibration, join: BurstJoiner
) -> None:
    frames = [frame(seen(RETINA, moved), 2000, k) for k, moved in enumerate(DRIFT_PX)]
    joined = join(frames)
    shifts = np.array([use.shift_px for use in joined.frames])
    assert np.sqrt(((shifts - DRIFT_PX) ** 2).mean()) < 0.2  # a tenth of a sample of the picture
    assert sum(use.weight for use in joined.frames) == pytest.approx(1)
    truth = seen(RETINA, (0, 0))
    one_db = psnr_db(solved(calibration, frames[0]), truth)
    four_db = psnr_db(solved_burst(calibration, frames[0], joined), truth)
    still_db = psnr_db(solved(calibration, frame(truth, 8000, 9)), truth)
    assert four_db - one_db > 0.75 * (still_db - one_db)  # four times the light on an eye that does not move


def test_frames_of_another_retina_and_of_a_closed_lid_are_left_out_with_a_reason(join: BurstJoiner) -> None:
    good = [frame(seen(RETINA, moved), 5000, k) for k, moved in enumerate(DRIFT_PX[:3])]
    lid = frame(0.4 * field(), 5000, 8)
    other = frame(seen(OTHER_RETINA, (0, 0)), 5000, 9)
    uses = join([lid, *good, other]).frames
    assert [use.used for use in uses] == [False, True, True, True, False]
    assert uses[1].shift_px == (0, 0)  # the first used frame is the reference
    assert all("what the other frames show" in (uses[k].reason or "") and uses[k].shift_px is None for k in (0, 4))


def test_a_frame_that_is_blurred_by_motion_is_left_out_and_costs_nothing(join: BurstJoiner) -> None:
    good = [frame(seen(RETINA, moved), 5000, k) for k, moved in enumerate(DRIFT_PX[:3])]
    places = np.linspace((0.0, -16.0), (0.0, 16.0), 17)  # a motion of 32 pixels during the exposure
    saccade = np.mean([seen(RETINA, (down, right)) for down, right in places], axis=0, dtype=np.float32)
    joined, alone = join([*good[:2], frame(saccade, 5000, 7), good[2]]), join(good)
    assert [use.used for use in joined.frames] == [True, True, False, True]
    assert "moved during its exposure" in (joined.frames[2].reason or "")
    assert np.nanmax(np.abs(joined.counts - alone.counts)) < 0.02 * np.nanmax(alone.counts)  # shifts within 0.01 pixels


@pytest.mark.parametrize(
    "peaks_e", [(5000, 5000, 5000, 1200), (600, 600, 150, 600), (200, 200, 200, 200), (60, 60, 60, 2000)]
)
def test_noise_is_not_taken_for_motion_blur(join: BurstJoiner, peaks_e: tuple[float, ...]) -> None:
    """A frame of less light than the others, or noise in the others, correlates less, and keeps its place."""
    frames = [frame(seen(RETINA, moved), peaks_e[k], 20 + k) for k, moved in enumerate(DRIFT_PX)]
    reasons = [use.reason or "" for use in join(frames).frames]
    assert not [reason for reason in reasons if "moved" in reason or "less sharp" in reason]


@pytest.mark.parametrize("place", [0, 2])
def test_each_kind_of_frame_that_one_frame_cannot_tell_is_named_by_the_others(join: BurstJoiner, place: int) -> None:
    """A read-out that was cut off, two eyes averaged, and a saccade, in one of four frames."""
    good = [frame(seen(RETINA, moved), 5000, k) for k, moved in enumerate(DRIFT_PX[:3])]
    both = (seen(RETINA, DRIFT_PX[3]) + seen(OTHER_RETINA, (0, 0))) / 2
    saccade = (seen(RETINA, (0, 0)) + seen(RETINA, (18, 24))) / 2
    cut = frame(seen(RETINA, DRIFT_PX[3]), 5000, 7)
    cut[: SHAPE[0] // 4] = BLACK_DN
    kinds = {
        "is black in": cut,
        "a second image over it": frame(both, 5000, 7),
        r"moved during its exposure, by about (2[5-9]|3\d) pixels": frame(saccade, 5000, 7),
    }
    for words, bad in kinds.items():
        uses = join([*good[:place], bad, *good[place:]]).frames
        assert [use.index for use in uses if not use.used] == [place]
        assert re.search(words, uses[place].reason or "")


def test_of_two_frames_the_one_with_a_black_part_is_left_out(join: BurstJoiner) -> None:
    good, cut = (frame(seen(RETINA, (0, 0)), 5000, k) for k in range(2))
    cut[:, : SHAPE[1] // 2] = BLACK_DN
    assert [use.used for use in join([cut, good]).frames] == [False, True]


@pytest.mark.parametrize("peak_e", [60, 600, 15000])
def test_no_frame_of_a_moving_eye_is_black(join: BurstJoiner, peak_e: float) -> None:
    uses = join([frame(seen(RETINA, moved), peak_e, k) for k, moved in enumerate(DRIFT_PX)]).frames
    assert not [use.reason for use in uses if "black" in (use.reason or "")]


def test_a_burst_with_one_usable_frame_is_that_frame(calibration: Calibration, join: BurstJoiner) -> None:
    usable, blank = frame(seen(RETINA, (0, 0)), 5000, 1), np.full(SHAPE, 4095, np.uint16)
    joined = join([blank, usable])
    assert [use.used for use in joined.frames] == [False, True]
    picture, alone = solved_burst(calibration, usable, joined), solved(calibration, usable)
    assert np.abs(picture - alone).max() < 0.02 * alone.max()  # single precision of the linearised frame
    with pytest.raises(FrameError, match="no frame of the burst can be used"):
        join([blank, blank])


def test_frames_of_different_light_are_weighted_by_it(join: BurstJoiner) -> None:
    frames = [frame(seen(RETINA, DRIFT_PX[k]), peak_e, k) for k, peak_e in enumerate((6000, 2000))]
    weights = [use.weight for use in join(frames).frames]
    assert weights == pytest.approx([0.75, 0.25], abs=0.01)


def test_without_a_calibrated_field_the_lit_area_is_found(calibration: Calibration) -> None:
    unknown = replace(calibration, field_deg=None)
    frames = [frame(seen(RETINA, moved), 5000, k) for k, moved in enumerate(DRIFT_PX[:2])]
    uses = BurstJoiner(unknown, SHAPE, PLANNER, SystemClock())(frames).frames
    assert uses[1].shift_px == pytest.approx(DRIFT_PX[1], abs=0.3)  # the field's edge alone would give 0
    grid = Grid.periodic(SHAPE, 1, float("inf"))
    overlap = (lit_field(seen(RETINA, (0, 0)), grid) * field()).sum() / field().sum()
    assert overlap > 0.97  # the edge is smoothed over 6 of 150 pixels


@settings(max_examples=20, deadline=None)
@given(st.floats(-12, 12), st.floats(-12, 12))
def test_moved_back_shifts_band_limited_images_exactly(down: float, right: float) -> None:
    rows, cols = np.mgrid[:64, :72]

    def wave(r: np.ndarray, c: np.ndarray) -> Image:
        return np.asarray(np.cos(2 * np.pi * (0.21 * r + 0.13 * c)) + 0.5 * np.sin(2 * np.pi * 0.3 * c), np.float32)

    moved, good = moved_back(wave(rows - down, cols - right), np.ones((64, 72), np.float32), (down, right))
    inner = (slice(18, -18), slice(18, -18))  # the largest shift and the taps
    assert good[inner].all()
    assert np.abs(moved - wave(rows, cols))[inner].max() < 0.02  # ripple of eleven taps at 0.3 cycles per pixel


def test_moved_back_marks_what_is_missing_or_from_beyond_the_image() -> None:
    good = np.ones((40, 40), np.float32)
    good[20, 20] = 0
    _, kept = moved_back(np.ones((40, 40), np.float32) * good, good, (3.0, 0.0))
    assert kept[17, 20] == 0
    assert kept[36, 5] == 1
    assert not kept[37:].any()
    assert kept.sum() == 37 * 40 - 1


@settings(max_examples=15, deadline=None)
@given(st.floats(-20, 20), st.floats(-20, 20))
def test_registration_finds_the_shift_of_a_texture(down: float, right: float) -> None:
    registrar = Registrar(field(), 1)
    details = [registrar.detail(registrar.flat(seen(RETINA, moved))) for moved in ((0, 0), (down, right))]
    found = registrar.register(*details)
    assert found.shift_px == pytest.approx((down, right), abs=0.6)  # the window stands still: it pulls towards 0
    assert found.correlation > 6 * found.sd
