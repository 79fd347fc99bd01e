"""Reconstruction of a burst of the instrument: quick look, joined frame, deadline, and a burst of one good frame."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from device.clock import Deadline, SystemClock
from device.errors import FrameError, SettingError
from device.recon.burst_reconstructor import NO_TIME, NOT_SOLVED, BurstReconstructor
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe, RoundDone, StageResult
from device.values import Image, Reconstruction
from tests.moving_retina import (
    DRIFT_PX,
    OTHER_RETINA,
    RETINA,
    SHAPE,
    burst_calibration,
    frame,
    seen,
)
from tests.unit.test_burst import psnr_db

PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")
COUNT = 4


@pytest.fixture(scope="module")
def bursts() -> BurstReconstructor:
    return BurstReconstructor(Reconstructor(burst_calibration(), SHAPE, PLANNER, SystemClock()), PLANNER)


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    return [frame(seen(RETINA, moved), 2000, k) for k, moved in enumerate(DRIFT_PX[:COUNT])]


def picture(bursts: BurstReconstructor, frames: list[np.ndarray], deadline: Deadline | None = None) -> Reconstruction:
    *_, made = bursts.steps(frames, simulated=True, deadline=deadline)
    assert isinstance(made, Reconstruction)
    return made


def truth() -> Image:
    return seen(RETINA, (0.0, 0.0))


def test_a_burst_gives_one_quick_look_pauses_and_one_better_picture(bursts: BurstReconstructor, frames: list) -> None:
    steps = list(bursts.steps(frames, simulated=True))
    looks = [step for step in steps if isinstance(step, StageResult)]
    assert isinstance(steps[0], StageResult)
    assert [look.last for look in looks] == [False, True]
    assert sum(isinstance(step, RoundDone) for step in steps) >= COUNT
    alone, made = picture(bursts, frames[:1]), steps[-1]
    assert isinstance(made, Reconstruction)
    assert made.simulated
    # two of three decibels of a still eye
    assert psnr_db(made.picture, truth()) > psnr_db(alone.picture, truth()) + 0.7
    assert [use.used for use in made.report.frames] == [True] * COUNT
    assert made.report.seconds["join"] > 0


def test_one_stage_would_solve_the_first_frame_alone_and_is_refused() -> None:
    single = Reconstructor(burst_calibration(), SHAPE, PLANNER, SystemClock(), (Recipe("variation", 2),), timed=False)
    with pytest.raises(SettingError, match="quick look"):
        BurstReconstructor(single, PLANNER)


def test_a_burst_is_in_dn_of_one_exposure(bursts: BurstReconstructor, frames: list) -> None:
    alone, made = picture(bursts, frames[:1]), picture(bursts, frames)
    assert made.picture.mean() == pytest.approx(alone.picture.mean(), rel=0.02)  # the noise of one frame
    figures, of_one = made.report, alone.report
    assert figures.quality["mean_dn"] == pytest.approx(of_one.quality["mean_dn"], rel=0.01)
    assert figures.noise_dn == pytest.approx(of_one.noise_dn / COUNT**0.5, rel=0.1)
    assert figures.regularisation["flat_dn"] == pytest.approx(of_one.regularisation["flat_dn"], rel=0.05)


def test_frames_prepared_during_the_exposure_give_the_same_picture(bursts: BurstReconstructor, frames: list) -> None:
    ready = {k: bursts.prepare(frames[k], refract=k == 0) for k in range(COUNT - 1)}  # the last one is not prepared
    look, *steps = bursts.steps(frames, simulated=True, prepared=ready)
    assert isinstance(look, StageResult)
    assert np.array_equal(look.picture, next(iter(bursts.steps(frames, simulated=True))).picture)
    made, apart = steps[-1], picture(bursts, frames)
    assert isinstance(made, Reconstruction)
    assert np.array_equal(made.picture, apart.picture)
    assert made.report.frames == apart.report.frames
    assert made.report.refraction_dpt == apart.report.refraction_dpt
    assert made.report.quality == apart.report.quality


def test_frames_joined_during_the_exposure_give_the_same_picture(bursts: BurstReconstructor, frames: list) -> None:
    ready = {k: bursts.prepare(counts, refract=k == 0) for k, counts in enumerate(frames)}
    joined = bursts.join(frames, None, {}, ready)
    *_, made = bursts.steps(frames, simulated=True, prepared=ready, joined=joined)
    apart = picture(bursts, frames)
    assert isinstance(made, Reconstruction)
    assert np.array_equal(made.picture, apart.picture)
    assert made.report.frames == apart.report.frames
    assert made.report.quality == apart.report.quality


def test_a_frame_prepared_alone_gives_the_same_picture(bursts: BurstReconstructor, frames: list) -> None:
    ready = bursts.prepare(frames[0], alone=True)
    look, *_, made = bursts.steps(frames[:1], simulated=True, prepared={0: ready})
    apart = picture(bursts, frames[:1])
    assert look is ready.look.stage
    assert isinstance(made, Reconstruction)
    assert np.array_equal(made.picture, apart.picture)
    with pytest.raises(FrameError, match="no signal"):
        bursts.prepare(np.full(SHAPE, 64, np.uint16), alone=True)


@pytest.mark.parametrize("count", [2, 3])
def test_fewer_frames_than_planned_have_the_noise_of_fewer(
    bursts: BurstReconstructor, frames: list, count: int
) -> None:
    made = picture(bursts, frames[:count])
    assert made.report.residual == pytest.approx(1, abs=0.25)  # what is left is noise of the assumed size
    assert psnr_db(made.picture, truth()) > psnr_db(picture(bursts, frames[:1]).picture, truth()) + 0.3


def test_a_burst_of_one_good_frame_is_that_frame(bursts: BurstReconstructor, frames: list) -> None:
    others = [frame(seen(OTHER_RETINA, (0.0, 0.0)), 2000, 7), np.full(SHAPE, 64, np.uint16)]
    made = picture(bursts, [frames[0], *others])
    assert [use.used for use in made.report.frames] == [True, False, False]
    assert all(use.reason for use in made.report.frames[1:])
    assert np.array_equal(made.picture, picture(bursts, frames[:1]).picture)


def test_a_deadline_without_time_to_join_gives_the_first_frame(bursts: BurstReconstructor, frames: list) -> None:
    made = picture(bursts, frames, Deadline.after(SystemClock(), 0.001))
    assert [(use.used, use.reason) for use in made.report.frames] == [(True, None), *[(False, NO_TIME)] * 3]
    assert made.report.stopped == "deadline"
    later = picture(bursts, frames, Deadline.after(SystemClock(), 60))
    assert all(use.used for use in later.report.frames)


@dataclass(frozen=True)
class ShortSteps(Deadline):
    """Deadline that leaves time for every step of at most `longest_s()`, which follows the pace of the machine."""

    longest_s: Callable[[], float] = float

    def fits(self, cost_s: float) -> bool:
        return cost_s <= self.longest_s()

    def later(self, delay_s: float) -> "ShortSteps":
        return self


def test_as_many_frames_are_joined_as_leave_time_for_rounds(bursts: BurstReconstructor, frames: list) -> None:
    """Rounds on fewer frames are worth more than a joined frame that is not solved."""
    picture(bursts, frames)  # measures the cost of each step
    costs = bursts.see_cost, bursts.join_cost

    def leaves_time_for(count: int) -> float:
        joining_s = sum(cost.seconds_of(count) + cost.typical_s / 2 for cost in costs)
        return joining_s + bursts.single.stages[-1].reserved_s

    for count in (3, 1):
        made = picture(bursts, frames, ShortSteps(SystemClock(), 0.0, partial(leaves_time_for, count)))
        assert [use.used for use in made.report.frames] == [k < count for k in range(COUNT)]
        assert {use.reason for use in made.report.frames if not use.used} == {NO_TIME}
    assert (made.report.seconds["join"], made.report.rounds) == (0.0, bursts.single.stages[-1].most)


def test_a_joined_frame_is_as_saturated_as_its_first(bursts: BurstReconstructor, frames: list) -> None:
    bright = [frame.copy() for frame in frames]
    for counts in bright:
        counts[170:190, 230:250] = bursts.single.calibration.sensor.white_dn
    made = picture(bursts, bright)
    assert sum(use.used for use in made.report.frames) > 1
    assert made.report.quality["saturated"] == picture(bursts, bright[:1]).report.quality["saturated"] > 0.001
    assert any("too bright" in warning for warning in made.report.warnings)


class TimeToJoinOnly(Deadline):
    """Deadline that leaves time for what is asked for first, the joining, and for nothing after it."""

    asked = 0

    def fits(self, cost_s: float) -> bool:
        type(self).asked += 1
        return type(self).asked == 1

    def later(self, delay_s: float) -> "TimeToJoinOnly":
        return self


def test_a_deadline_after_the_joining_gives_one_frame_and_the_report_says_so(
    bursts: BurstReconstructor, frames: list
) -> None:
    made = picture(bursts, frames, TimeToJoinOnly(SystemClock(), 0.0))
    assert [(use.used, use.reason) for use in made.report.frames] == [(True, None), *[(False, NOT_SOLVED)] * 3]
    assert made.report.stopped == "deadline"


def test_a_quick_look_between_two_steps_does_not_change_the_picture(bursts: BurstReconstructor, frames: list) -> None:
    alone = picture(bursts, frames)
    for step in bursts.steps(frames, simulated=True):
        if isinstance(step, RoundDone):
            bursts.single(frame(seen(OTHER_RETINA, (0.0, 0.0)), 2000, 8), quick=True)
    assert isinstance(step, Reconstruction)
    assert np.array_equal(step.picture, alone.picture)


def test_a_frame_of_another_shape_is_refused(bursts: BurstReconstructor, frames: list) -> None:
    with pytest.raises(FrameError, match="pixels"):
        picture(bursts, [frames[0][::2], frames[1]])
