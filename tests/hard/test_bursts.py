"""Bursts and colours: error bounds of joining, which is linear once the shifts are known, and displaced frames.

Joining is a weighted mean, with weights of sum 1, of residuals that a windowed sinc has moved; its noise gain at one
pixel is at most 1 (up to 0.4 cycles per pixel it is 1, NUMERICS.md 9.2). Single precision rounds each of the N sums and
the two passes over the smooth part.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from device.clock import SystemClock, VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.recon.assessment.exposure_split import MIN_GAIN_DB, PressLight, choose_split
from device.recon.burst import BurstJoiner, JoinedFrame
from device.recon.colour import join_colours
from device.recon.estimation.registration import Shift
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor
from device.sim.objects import moved_behind_field
from device.sim.render import crop_or_pad
from device.values import Counts, Image, Reconstruction
from services.instrument.capture_pipeline import plan_pipeline
from services.instrument.press_exposure import expose_press
from tests import scenes
from tests.moving_retina import (
    BLACK_DN,
    DRIFT_PX,
    FIELD_PX,
    GAIN_E,
    READ_E,
    RETINA,
    SHAPE,
    burst_calibration,
    field,
    frame,
    seen,
)
from tests.simulated import coarse, with_keys, world

SIM = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
SPEED_DEG_PER_S = 5.0  # a motion that lasts: the fastest that the simulator takes for no saccade
Within = Callable[[float, float], None]
EPSILON = 2.0**-24  # half a unit in the last place of float32, relative
FAR_PX: tuple[Shift, ...] = ((0.0, 0.0), (18.0, 24.0), (-30.0, 0.3), (0.5, -30.0))
INNER = disc(SHAPE, ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2), FIELD_PX / 2 - 66) > 0.5  # seen by all, off the edge


@pytest.fixture(scope="module")
def join() -> BurstJoiner:
    return BurstJoiner(burst_calibration(), SHAPE, scenes.PLANNER, SystemClock())


@pytest.fixture(scope="module")
def solve() -> Reconstructor:
    return Reconstructor(burst_calibration(), SHAPE, scenes.PLANNER, SystemClock(), refract=False, timed=False)


def noise_dn(counts: Counts) -> Image:
    """Return the standard deviation of the noise of each pixel."""
    electrons = np.maximum(counts - BLACK_DN, 0) * GAIN_E + READ_E**2
    return np.asarray(np.sqrt(electrons) / GAIN_E, np.float32)


@pytest.mark.parametrize("count", [2, 4, 16])
def test_copies_of_one_frame_join_to_that_frame(join: BurstJoiner, within: Within, count: int) -> None:
    shot = frame(seen(RETINA, (0, 0)), 5000, 1)
    joined = join([shot] * count)
    linear = shot.astype(np.float64) - BLACK_DN
    within(float(np.abs(joined.counts - linear).max() / linear.max()), (count + 2) * 2 * EPSILON)
    assert joined.light == pytest.approx(count)


@pytest.mark.parametrize("places", [DRIFT_PX, FAR_PX], ids=["drift", "30 px"])
def test_the_noise_of_a_burst_is_that_of_the_mean(join: BurstJoiner, within: Within, places: list[Shift]) -> None:
    """Two bursts that differ by their noise only; both find the shifts to a hundredth of a pixel at this light."""
    first, second = ([frame(seen(RETINA, at), 20000, seed + k) for k, at in enumerate(places)] for seed in (10, 50))
    joined = [join(burst) for burst in (first, second)]
    assert all(use.used for burst in joined for use in burst.frames)
    difference = (joined[0].counts - joined[1].counts)[INNER]
    expected = noise_dn(first[0])[INNER] * np.sqrt(2 / len(places))
    # 1 by theory; the shifts of the two bursts differ too, and quantisation adds a twelfth of a squared count.
    within(float(difference.std() / np.sqrt((expected**2).mean())), 1.1)


@pytest.mark.parametrize("far_px", [10.0, 30.0, 60.0])
def test_displaced_frames_leave_no_gap_where_most_of_them_see_the_retina(
    join: BurstJoiner, solve: Reconstructor, within: Within, far_px: float
) -> None:
    places = [(0.0, 0.0), (far_px, 0.0), (0.0, -far_px), (-0.6 * far_px, 0.8 * far_px)]
    joined = join([frame(seen(RETINA, at), 8000, k) for k, at in enumerate(places)])
    used = [use for use in joined.frames if use.used]
    assert {0} <= {use.index for use in used}
    for use in used:
        assert use.shift_px is not None
        # A sixteenth of the finest period of the band of registration, 1 / 0.12 px.
        within(float(np.abs(np.subtract(use.shift_px, places[use.index])).max()), 0.5)
    missing = ~np.isfinite(joined.counts)
    reach = int(far_px) + 6  # the taps of the sinc
    assert not missing[reach:-reach, reach:-reach].any(), "each pixel away from the border is on every frame"
    assert np.isfinite(solve(joined.counts + np.float32(BLACK_DN)).picture).all()


@pytest.mark.parametrize("spoil", ["dark", "saturated", "NaN", "noise"])
def test_a_useless_frame_changes_nothing(join: BurstJoiner, within: Within, spoil: str) -> None:
    good = [frame(seen(RETINA, at), 5000, k) for k, at in enumerate(DRIFT_PX[:3])]
    bad = {
        "dark": np.full(SHAPE, BLACK_DN),
        "saturated": np.full(SHAPE, 4095.0),
        "NaN": np.full(SHAPE, np.nan),
        "noise": np.random.default_rng(3).uniform(BLACK_DN, 700, SHAPE),
    }[spoil].astype(np.float32)
    alone, mixed = join(good), join([*good[:2], bad, good[2]])
    assert [use.used for use in mixed.frames] == [True, True, False, True]
    assert mixed.frames[2].reason
    within(_relative(mixed, alone), 10 * EPSILON)


def _relative(left: JoinedFrame, right: JoinedFrame) -> float:
    """Return the largest difference of two joined frames over the largest value."""
    assert np.array_equal(np.isfinite(left.counts), np.isfinite(right.counts))
    return float(np.nanmax(np.abs(left.counts - right.counts)) / np.nanmax(np.abs(right.counts)))


@pytest.mark.parametrize("far_px", [0.0, 7.0, 30.0, 60.0])
def test_colours_that_far_apart_are_brought_together(within: Within, far_px: float) -> None:
    """Red that shows the same retina with half the contrast, another shading and noise."""
    shift = (0.6 * far_px, -0.8 * far_px)
    green, moved = seen(RETINA, (0, 0)), seen(RETINA, shift)
    shading = 1 + 0.3 * np.linspace(-1, 1, SHAPE[1], dtype=np.float32)
    noise = np.random.default_rng(4).normal(0, 0.02, SHAPE).astype(np.float32)
    red = (0.5 + 0.5 * moved) * field() * shading * 4 + noise
    joined = join_colours({"green": green, "red": red}, field(), 1)
    (found,) = (channel.shift_px for channel in joined.channels if channel.name == "red")
    assert joined.doubtful == ()
    assert found is not None
    within(float(np.abs(np.subtract(found, shift)).max()), 0.3)
    assert np.isfinite(joined.picture).all()
    gain = np.corrcoef(joined.picture[..., 0][INNER], green[INNER])[0, 1]
    within(1 - float(gain), 0.35)  # its shading, a third of the contrast, is no error


def test_a_colour_of_another_eye_is_not_moved_and_the_picture_says_so() -> None:
    other = np.asarray(np.rot90(RETINA, 2), np.float32)
    joined = join_colours({"green": seen(RETINA, (0, 0)), "red": seen(other, (0, 0))}, field(), 1)
    assert joined.doubtful == ("red",)
    (red,) = (channel for channel in joined.channels if channel.name == "red")
    assert red.shift_px == (0.0, 0.0)


def test_a_split_press_of_a_moving_simulated_eye_is_nearer_to_the_truth(tmp_path: Path) -> None:
    """Chosen as the instrument does, for the same light; its gain is predicted within the error of the fit."""
    spec = with_keys(coarse(load_head(SIM), 2), eye={"drift_deg_per_s": SPEED_DEG_PER_S})
    clock = VirtualClock()
    head = open_head(spec, clock, MemoryLedger(clock))
    try:
        pipeline = plan_pipeline(head, clock, tmp_path)
        assert pipeline.bursts is not None
        corrected_db, doses, splits = [], [], []
        for speed in (None, SPEED_DEG_PER_S):
            split = choose_split(4, spec.camera.exposure_s, speed, PressLight(200 / spec.camera.exposure_s, 0.0))
            clock.sleep(60)  # the guard asks for darkness
            press = expose_press(head, ("OD",), clock, count=4, split=split)
            *_, made = pipeline.bursts.steps([shot.counts for shot in press.lit], simulated=True)
            assert isinstance(made, Reconstruction)
            assert all(use.used for use in made.report.frames)
            corrected_db.append(_psnr_db(made.picture, spec))
            doses.append(press.dose_j_per_cm2)
            splits.append(split)
    finally:
        head.close()
    assert [choice.parts for choice in splits] == [1, 2]
    assert doses[1] == pytest.approx(doses[0])
    gain_db = corrected_db[1] - corrected_db[0]
    assert gain_db == pytest.approx(splits[1].gain_db, abs=3 * MIN_GAIN_DB), "three times the largest error of the fit"
    assert gain_db > 0.3


def _psnr_db(picture: Image, spec: InstrumentSpec) -> float:
    """Return the PSNR after the best linear scale, for the best place of the moving retina along its way, in dB."""
    moving = world(spec)
    step_px, radius_px = moving.eyes.drift_px, moving.geometry.px_per_deg * moving.scene.half_field_deg
    inside = ndimage.binary_erosion(moving.truth("green") > 0, iterations=int(3 * step_px) + 8)
    found = []
    for way in np.arange(-0.5, 0.51, 0.125):
        moved = moved_behind_field(moving.retina, (0.0, float(way) * step_px), radius_px).plane("green")
        truth, seen_there = crop_or_pad(moved, moving.shape)[inside], picture[inside]
        rest = np.polyval(np.polyfit(seen_there, truth, 1), seen_there) - truth
        found.append(10 * np.log10(np.ptp(truth) ** 2 / np.mean(rest**2)))
    return float(max(found))
