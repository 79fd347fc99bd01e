"""Split of exposures while the eye moves: when, into how many frames, and the measurements that it rests on."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.recon.assessment.exposure_split import (
    MAX_FRAMES,
    MIN_GAIN_DB,
    MIN_MOTION_DEG,
    WHOLE,
    PressLight,
    choose_split,
    dark_fits,
    loss_db,
)
from device.recon.assessment.frame_quality import MIN_E_PER_UM2

DEG_PER_PX = 1 / 15.583  # of the paper's sensor
E_PER_UM2 = 0.28 * 1000 / 5.04**2  # mean light of frames whose brightest pixel of 5.04 um holds 1,000 electrons

# Photograph HRF 14_h: thousands of electrons in the brightest pixel, motion in pixels over the light, PSNR of one
# exposure, of 4 and of 8 frames that share the light.
MEASURED = [
    (20, 0, (33.30, 33.27, 33.23)),
    (20, 4, (32.68, 33.17, 33.25)),
    (20, 11, (31.89, 32.43, 32.66)),
    (2, 0, (30.41, 30.25, 30.10)),
    (2, 3, (30.28, 30.22, 29.97)),
    (2, 12, (29.31, 30.05, 29.94)),
]

counts = st.integers(1, 6)
exposures_s = st.floats(0.005, 0.5)
speeds_deg_per_s = st.floats(0, 60)
lights_e_per_um2_s = st.floats(0.01, 1e5)
overheads_s = st.floats(0, 0.1)


@pytest.mark.parametrize(("thousand_e", "motion_px", "psnr_db"), MEASURED)
def test_the_loss_is_that_of_the_measured_pictures(thousand_e, motion_px, psnr_db) -> None:
    still_db = next(found[0] for light, motion, found in MEASURED if (light, motion) == (thousand_e, 0))
    for frames, found_db in zip((1, 4, 8), psnr_db, strict=True):
        predicted_db = loss_db(frames, motion_px * DEG_PER_PX, thousand_e * E_PER_UM2)
        assert predicted_db == pytest.approx(still_db - found_db, abs=0.16)  # the error of the fit


@given(counts, exposures_s, speeds_deg_per_s, lights_e_per_um2_s, overheads_s)
def test_a_split_adds_no_light_and_is_made_for_a_gain(
    count, exposure_s, speed_deg_per_s, light_e_per_um2_s, overhead_s
) -> None:
    split = choose_split(count, exposure_s, speed_deg_per_s, PressLight(light_e_per_um2_s, overhead_s))
    if split == WHOLE:
        return
    motion_deg, light_e_per_um2 = speed_deg_per_s * exposure_s, light_e_per_um2_s * exposure_s
    assert split.parts >= 2
    assert split.parts * count <= MAX_FRAMES
    assert split.motion_deg == pytest.approx(motion_deg)
    assert split.motion_deg > MIN_MOTION_DEG
    assert split.part_s is not None
    assert light_e_per_um2_s * split.part_s > MIN_E_PER_UM2, "a part would be judged as too dark"
    assert split.parts * (split.part_s + overhead_s) == pytest.approx(exposure_s + overhead_s), (
        "the lamp is on for longer"
    )
    whole_db, parts_db = (
        loss_db(frames, count * motion_deg, count * light_e_per_um2) for frames in (count, count * split.parts)
    )
    assert split.gain_db <= whole_db - parts_db + 1e-9, "shorter light is no gain"  # rounding
    assert split.gain_db >= MIN_GAIN_DB


@given(counts, exposures_s, lights_e_per_um2_s)
def test_an_eye_that_stands_still_or_is_not_seen_has_whole_exposures(count, exposure_s, light_e_per_um2_s) -> None:
    for speed_deg_per_s in (None, 0.0, MIN_MOTION_DEG / exposure_s * 0.999):
        assert choose_split(count, exposure_s, speed_deg_per_s, PressLight(light_e_per_um2_s, 0.0)) == WHOLE
    assert choose_split(count, exposure_s, 10.0, None) == WHOLE, "the light is not known"


def test_an_overhead_of_the_frames_takes_light_from_a_split() -> None:
    """0.1 s of 200 electrons per um^2, 5 degrees per second: 5 ms of overhead cost little, 40 ms all of the gain."""
    none, short, long = (choose_split(1, 0.1, 5.0, PressLight(2000.0, overhead_s)) for overhead_s in (0, 0.005, 0.04))
    assert none.parts * none.part_s == pytest.approx(0.1)
    assert short.parts * short.part_s < 0.1
    assert 0.3 < short.gain_db < none.gain_db
    assert long == WHOLE


@pytest.mark.parametrize(("exposure_s", "fits"), [(0.05, True), (0.1, True), (0.2, False), (0.8, False)])
def test_a_dark_frame_fits_frames_of_its_own_length(exposure_s: float, fits: bool) -> None:
    assert dark_fits(exposure_s, 0.1) is fits


@given(st.floats(0, 3), st.floats(0.1, 1e4), st.integers(1, 8))
def test_more_light_and_less_motion_of_one_exposure_lose_less(motion_deg, light_e_per_um2, frames) -> None:
    assert loss_db(frames, motion_deg, light_e_per_um2) >= 0
    assert loss_db(1, motion_deg, light_e_per_um2) <= loss_db(1, motion_deg + 0.1, light_e_per_um2)
    assert loss_db(frames, 0, light_e_per_um2) >= loss_db(frames, 0, 2 * light_e_per_um2)


def test_little_light_needs_more_motion() -> None:
    """A drift of 5 pixels in one exposure: a gain at 20,000 electrons, a loss at 2,000."""
    speed_deg_per_s = 5 * DEG_PER_PX / 0.1
    bright, dim = (choose_split(1, 0.1, speed_deg_per_s, PressLight(light * E_PER_UM2 / 0.1, 0.0)) for light in (20, 2))
    assert bright.parts > 1
    assert 0.4 < bright.gain_db < 0.9  # 0.5 dB measured with 4 pixels and 4 frames, 0.8 with 11 and 8
    assert dim == WHOLE
