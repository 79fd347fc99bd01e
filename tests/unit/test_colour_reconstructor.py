"""Colour pictures of an instrument: steps, deadline, refraction, and the reasons of a colour that is missing."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import ndimage

from device.clock import Deadline, SystemClock, VirtualClock
from device.recon.colour import RGB
from device.recon.colour_reconstructor import ColourReconstruction, ColourReconstructor
from device.recon.estimation.psf_warp import Wavefront
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import RoundDone, StageResult, Step
from device.recon.white_balance import OVER_GREEN
from device.values import ChannelUse, Colour, Image, Reconstruction
from tests.moving_retina import RETINA, SHAPE, burst_calibration, field, frame, seen

PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")
RED = np.asarray(0.6 + 0.4 * RETINA, np.float32)
MOVED_PX = (3.4, -5.2)
ROUNDS_OF_A_COLOUR = 6


class Bench:
    """Reconstructors of green and red, and one frame of each."""

    def __init__(self) -> None:
        calibration, clock = burst_calibration(), SystemClock()
        self.green, self.red = (Reconstructor(calibration, SHAPE, PLANNER, clock, refract=False) for _ in range(2))
        self.colours = ColourReconstructor(self.green, {"red": self.red})
        self.frames = {"green": frame(seen(RETINA, (0, 0)), 2000, 1), "red": frame(seen(RED, MOVED_PX), 2000, 2)}

    def steps(
        self, red: np.ndarray | None = None, deadline: Deadline | None = None, missing: Sequence[ChannelUse] = ()
    ) -> list[Step]:
        green = self.green.steps(self.frames["green"], simulated=True, deadline=deadline)
        frames: dict[Colour, list[np.ndarray]] = (
            {} if missing else {"red": [self.frames["red"] if red is None else red]}
        )
        return list(self.colours.steps(green, frames, simulated=True, deadline=deadline, missing=missing))

    def picture(self, **given: object) -> Reconstruction:
        *_, made = self.steps(**given)  # type: ignore[arg-type]
        assert isinstance(made, Reconstruction)
        return made


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


def test_green_comes_first_and_as_without_another_colour(bench: Bench) -> None:
    alone = list(bench.green.steps(bench.frames["green"], simulated=True))
    steps = bench.steps()
    assert [type(step) for step in steps[: len(alone) - 1]] == [type(step) for step in alone[:-1]]
    rest = steps[len(alone) - 1 :]
    assert {type(step) for step in rest[:-1]} == {RoundDone}, "the colours make no quick look"
    assert len(rest) > ROUNDS_OF_A_COLOUR
    assert isinstance(steps[0], StageResult)
    made, before = rest[-1], alone[-1]
    assert isinstance(made, ColourReconstruction)
    assert isinstance(before, Reconstruction)
    assert np.array_equal(made.picture, before.picture)
    assert made.simulated
    assert made.report.seconds["colour"] > 0


def test_the_picture_has_three_channels_on_the_grid_of_green(bench: Bench) -> None:
    made = bench.picture()
    assert isinstance(made, ColourReconstruction)
    green, red, blue = made.report.channels
    assert (red.name, red.predicted, red.reason) == ("red", False, None)
    assert red.shift_px == pytest.approx(MOVED_PX, abs=0.5)
    assert (green.name, green.shift_px) == ("green", (0.0, 0.0))
    assert (blue.name, blue.predicted, blue.shift_px) == ("blue", True, None)
    box = bench.colours.box
    inside = field()[box] > 0.5
    means = made.colour[inside].mean(axis=0)
    assert means / means[1] == pytest.approx([OVER_GREEN[colour] for colour in RGB], rel=1e-3)
    inside = ndimage.binary_erosion(inside, iterations=12)  # away from the edge, which moves with each channel
    of_red = {moved: correlation(made.colour[..., 0], seen(RED, moved)[box], inside) for moved in ((0, 0), MOVED_PX)}
    assert of_red[0, 0] > max(0.85, of_red[MOVED_PX] + 0.02)


def correlation(left: Image, right: Image, inside: np.ndarray) -> float:
    return float(np.corrcoef(left[inside], right[inside])[0, 1])


@pytest.mark.parametrize("budget_s", [0.001, 0.1, 60.0])
def test_no_budget_is_too_short_for_a_colour(bench: Bench, budget_s: float) -> None:
    """Else some pictures of a visit would be in colour and others not."""
    made = bench.picture(deadline=Deadline.after(SystemClock(), budget_s))
    assert isinstance(made, ColourReconstruction)
    assert [(channel.name, channel.reason) for channel in made.report.channels][:2] == [("green", None), ("red", None)]


def test_green_leaves_the_colours_their_time_and_has_half_of_it(bench: Bench) -> None:
    clock = VirtualClock()
    first = bench.red.stages[0]
    ends_s = first.end_cost.seconds + first.finish_cost.seconds
    least_s = first.start_cost.seconds + ends_s + bench.colours.join_cost.seconds
    assert least_s > 0
    for budget_s in (4 * least_s, least_s):
        deadline = Deadline.after(clock, budget_s)
        left_s = bench.colours.deadline_of_green(deadline, ["red"]).left_s()
        assert left_s == pytest.approx(max(budget_s - least_s, budget_s / 2))
        assert bench.colours.deadline_of_green(deadline, []) == deadline


def test_a_useless_frame_or_none_of_a_colour_gives_green_and_the_reason(bench: Bench) -> None:
    for given in (
        {"red": bench.frames["red"][::2]},
        {"missing": [ChannelUse("red", None, reason="no red light", code="light.limit")]},
    ):
        made = bench.picture(**given)
        assert not isinstance(made, ColourReconstruction)
        green, red = made.report.channels
        assert (green.shift_px, green.reason) == ((0.0, 0.0), None)
        assert (red.shift_px, bool(red.reason), bool(red.code)) == (None, True, True)


def test_red_is_solved_with_its_psf_stretched_as_that_of_green(bench: Bench) -> None:
    stage = bench.red.stages[-1]
    stored = stage.model.otf.copy()
    bench.colours.refocus("red", Wavefront(9.0, 1.0, 1.0))
    assert not np.allclose(stage.model.otf, stored, atol=0.05)
    bench.colours.refocus("red", None)
    assert np.array_equal(stage.model.otf, stored)


def test_a_quick_look_in_red_between_two_steps_does_not_change_the_picture(bench: Bench) -> None:
    alone = bench.picture()
    green = bench.green.steps(bench.frames["green"], simulated=True)
    for step in bench.colours.steps(green, {"red": [bench.frames["red"]]}, simulated=True):
        if isinstance(step, RoundDone):
            bench.red(frame(seen(RETINA, (9, 9)), 2000, 8), quick=True)
    assert isinstance(step, ColourReconstruction)
    assert isinstance(alone, ColourReconstruction)
    assert np.array_equal(step.colour, alone.colour)


def test_a_psf_of_any_colour_needs_no_reconstructor_of_its_own(bench: Bench) -> None:
    shared = ColourReconstructor(bench.green, {"red": bench.green})
    green = bench.green.steps(bench.frames["green"], simulated=True)
    *_, made = shared.steps(green, {"red": [bench.frames["red"]]}, simulated=True)
    own = bench.picture()
    assert isinstance(made, ColourReconstruction)
    assert isinstance(own, ColourReconstruction)
    assert np.array_equal(made.picture, own.picture)
    assert made.colour == pytest.approx(own.colour, rel=1e-4, abs=1e-4 * float(own.colour.max()))
