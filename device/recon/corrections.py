"""Corrections of a frame that the forward model does not explain: flicker, uneven light, ghost, spots, a pupil.

Each one changes the frame, or the PSF, solves it again, and is kept only if the forward model then explains the frame
better. None begins that would end after the deadline.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import hypot
from typing import NamedTuple

import numpy as np

from device.errors import FrameError
from device.recon.assessment.quality_figures import is_banded, states_misfit
from device.recon.durations import DurationEstimate, Pace
from device.recon.estimation.flicker import MIN_RATIO, SPOT_MIN_RATIO, FlickerFinder
from device.recon.estimation.ghost import Ghost, share_of
from device.recon.estimation.refraction.estimator import NoRefraction
from device.recon.estimation.refraction.notation import doubt_of, widened
from device.recon.estimation.sensor_lines import LINE_NOISES
from device.recon.estimation.spots import Spots, on_sensor
from device.recon.estimation.uneven_light import FALLS, UnevenLight
from device.recon.frame_run import FrameRun
from device.recon.stage import Step
from device.values import Calibration, Image, Mask, Reconstruction, Report

SPOT_SEARCHES = 4
MIN_SPOTTED = 0.9  # rms residual beyond which spots are searched for: noise has 0.85 to 1.01, faint spots to 1.03
GHOST_SEARCHES = 4
GHOST_BETTER = 0.997  # of the residual: a ghost of 10 % 0.959 to 0.993, noise of columns 0.999
SPOT_GHOST_FALL = 0.05  # behind lenslets, of the residual over the share: what they leave beyond the field 0.017
MIN_SHARE, MAX_SHARE = 0.01, 0.8  # of the light of the first image
MIN_GHOST = 0.035  # of it: in stray light of 20 % one of 0.025 was found that is none; less costs no picture
GHOST_FALLS = 0.25  # of the trace of a ghost: less is left of one that is taken out
MAX_HIDDEN = 0.15  # share of the sensor: with more the frame is another one
BETTER = 0.9  # of the residual of the whole frame: by chance up to 0.97, dust at 500 electrons 0.78
MAX_EXPLAINED = 1.2  # rms residual of a frame without its spots: 0.86 to 1.0
DUST = (
    "Dark spots, {share:.1%} of the frame, were left out; the largest is at row {row}, column {col} of the sensor. "
    "Clean the sensor and the optics before it; if they stay, measure the flat frame again."
)
LINES_SD_DPT = 25.0  # of M, J0 and J45 per share of the light: errors of 15 to 40 in frames of 1 and 3 %, two sensors
PUPIL_SOLUTIONS = 4  # duration of search, planning and solution for a pupil, in solutions of the frame
PUPIL_SD_DPT = 0.5  # of M, J0 and J45 per hidden share of the PSF: 10 frames of 4 pupils were off by up to 0.9 times it
PUPIL = (
    "The pupil hides {share:.0%} of the light; the picture was made with the rest. "
    "Centre the head on the pupil, or wait until it is wider; take it again."
)

Solve = Callable[[FrameRun], Generator[Step, None, Reconstruction]]


class BehindPupil(NamedTuple):
    """Run and picture of a frame with the PSF behind a pupil, and the share of the PSF's light that it hides."""

    run: FrameRun
    made: Reconstruction
    hidden: float


SolveBehindPupil = Callable[[FrameRun], Generator[Step, None, BehindPupil | None]]


@dataclass(frozen=True)
class Solution:
    """Picture of a frame, and what was corrected in it.

    Attributes
    ----------
    run
        Run of the corrected frame.
    made
        Its picture, and its report without the corrections.
    found
        Size of each correction by its name in the report.
    notes
        Message of each correction that the reader of the report can do something about.
    others_s
        Duration of the solutions of the frame that are not used, in seconds.
    """

    run: FrameRun
    made: Reconstruction
    found: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    others_s: float = 0.0

    def with_correction(self, name: str, size: float, *notes: str) -> "Solution":
        """Return the solution with one more correction."""
        return replace(self, found={**self.found, name: size}, notes=(*self.notes, *notes))

    def choice(self, used: "Solution", tried: Sequence["Solution"]) -> "Solution":
        """Return `used`, this solution or one of those that were tried after it, with the corrections of this one."""
        others_s = self.others_s + sum(other.duration_s for other in (self, *tried) if other is not used)
        return replace(used, found=self.found, notes=self.notes, others_s=others_s)

    @property
    def duration_s(self) -> float:
        """Duration of the solution in seconds."""
        return sum(self.made.report.seconds.values())

    @property
    def picture(self) -> Reconstruction:
        """The picture with the corrections in its report."""
        return with_corrections(self.made, self.found, self.notes, self.others_s)


class Corrections:
    """The corrections of the frames of one calibration and one sensor shape, tried one after the other.

    Parameters
    ----------
    calibration
        Calibration of the head.
    shape
        (rows, cols) of the sensor in pixels.
    dark_dn
        Dark frame of a frame without its own.
    solve
        Solver of a run: yields the steps before the picture, and returns the picture.
    solve_behind_pupil
        The same behind the pupil that is found in the frame of a run; returns None without a pupil. None: no search.
    pace
        Pace of the machine.
    """

    def __init__(
        self,
        calibration: Calibration,
        shape: tuple[int, int],
        dark_dn: Image,
        solve: Solve,
        solve_behind_pupil: SolveBehindPupil | None,
        pace: Pace,
    ) -> None:
        min_ratio = SPOT_MIN_RATIO if calibration.has_spots else MIN_RATIO
        self.flicker = FlickerFinder(dark_dn, calibration.sensor.white_dn, min_ratio)
        self._white_dn = calibration.sensor.white_dn
        self._has_spots = calibration.has_spots
        self._shape = shape
        self._dark_dn = dark_dn
        self._solve = solve
        self._solve_behind_pupil = solve_behind_pupil
        self._search_cost = DurationEstimate(pace)  # of the search for uneven light

    def __call__(self, run: FrameRun, made: Reconstruction) -> Generator[Step, None, Reconstruction]:
        """Yield the steps of the corrected frames of a run, and return the best picture.

        Parameters
        ----------
        run
            Run of the whole frame.
        made
            Its picture.

        Yields
        ------
        StageResult or RoundDone
            The steps before a picture.
        """
        best = Solution(run, made)
        if run.joined is not None or run.done.is_closed_form:
            best = yield from self._without_spots(best)
            return best.picture
        best = yield from self._without_flicker(best)
        steady = best.run
        best = yield from self._in_even_light(best)
        is_cut = best.run is steady and _is_cut(steady)
        if is_cut:
            best = yield from self._behind_pupil(best)
        if best.run is steady:  # stray light that was taken out in part, and a pupil, leave light like that of a ghost
            best = yield from self._without_ghost(best)
        best = yield from self._without_spots(best)
        if not is_cut:
            best = yield from self._behind_pupil(best)
        return best.picture

    def _again(self, run: FrameRun) -> Generator[Step, None, Solution | None]:
        """Yield the steps of a corrected frame, and return its solution; None if too little of the frame is left."""
        try:
            made = yield from self._solve(run)
        except FrameError:  # the picture of the whole frame stays, and its warnings say what the frame shows
            return None
        return Solution(run, made)

    def _without_flicker(self, whole: Solution) -> Generator[Step, None, Solution]:
        """Return the solution of the frame without flicker, if it shows any."""
        run = whole.run
        if not is_banded(whole.made.report.quality) or not run.fits(whole.duration_s):
            return whole
        steady = self.flicker(run.counts, run.asked.dark)
        again = None if steady is None else (yield from self._again(run.again(steady.counts)))
        if steady is None or again is None:
            return whole
        if not is_steadier(whole.made, again.made):
            return whole.choice(whole, [again])
        return whole.choice(again, [again]).with_correction("flicker", steady.flicker)

    def _without_ghost(self, whole: Solution) -> Generator[Step, None, Solution]:
        """Return the solution of the frame without a displaced second image, if its trace falls to a quarter.

        The trace is in proportion to what is left of the ghost: the share is found by the secant method.
        """
        run, ghost = whole.run, None if whole.run.diagnostics is None else whole.run.diagnostics.ghost
        whole_trace = _trace(run, ghost)
        if ghost is None or not whole_trace > 0:
            return whole
        before, last = (0.0, whole_trace), share_of(whole_trace)
        tried: list[Solution] = []
        for _ in range(GHOST_SEARCHES):
            if not run.fits(whole.duration_s):
                break
            light = ghost.removal(last, run.done.grid)
            again = yield from self._again(run.again(self._even(run, light), white=False))
            if again is None:
                break
            tried.append(again)
            left = _trace(again.run, ghost)
            is_ghost = not self._has_spots or _falls(whole, again, 1 - SPOT_GHOST_FALL * light.share)
            if abs(left) < GHOST_FALLS * whole_trace:
                is_better = light.share >= MIN_GHOST and is_ghost and _falls(whole, again, GHOST_BETTER)
                if not is_better or states_misfit(again.made.report.warnings):
                    break
                return whole.choice(again, tried).with_correction(light.key, light.share, light.words)
            if left >= before[1] or (left > 0 and not is_ghost):  # a share that is too large may raise the residual
                break
            secant = (last - before[0]) / (before[1] - left)
            before, last = (last, left), min(max(last + left * secant, MIN_SHARE), MAX_SHARE)
        return whole.choice(whole, tried)

    def _even(self, run: FrameRun, light: UnevenLight) -> Image:
        """Return the counts of a run as in even light."""
        _, dark, _ = run.channel(0)
        offset = self._dark_dn if dark is None else np.asarray(dark, np.float32)
        return light.without(run.counts, offset, self._white_dn, run.done.grid)

    def _in_even_light(self, whole: Solution) -> Generator[Step, None, Solution]:
        """Return the solution of the frame as in even light, if its unevenness halves."""
        run, before = whole.run, _unevenness(whole.run)
        find = None if run.diagnostics is None else run.diagnostics.find_uneven
        if before is None or find is None:
            return whole
        if not run.fits(self._search_cost.seconds + whole.duration_s):
            self._search_cost.skipped(usually_fits=False)  # forgets a stall
            return whole
        begin_s, tried = run.clock.now_s(), []
        lights = find()
        self._search_cost.add(run.clock.now_s() - begin_s)
        for light in lights:
            if not run.fits(whole.duration_s):
                break
            again = yield from self._again(run.again(self._even(run, light)))
            if again is None:
                continue
            tried.append(again)
            after = _unevenness(again.run)
            is_even = after is not None and after < FALLS * before and _falls(whole, again)
            if is_even and not states_misfit(again.made.report.warnings):
                return whole.choice(again, tried).with_correction(light.key, light.share, light.words)
        return whole.choice(whole, tried)

    def _without_spots(self, whole: Solution) -> Generator[Step, None, Solution]:
        """Return the solution of the frame without its spots, if the forward model explains it.

        The first residual shows the largest spots only, beside errors that they cause around them: each search is one
        of the frame without the spots found before, also where the rest is too little to show in the rms residual.
        """
        first = spots = _spots(whole.run, MIN_SPOTTED)
        if first is None:
            return whole
        run, grid = whole.run, whole.run.done.grid  # a later solution may end after its quick look, on another grid
        joined, best, share, tried = run.joined, whole, 0.0, []
        hidden: Mask = np.zeros(self._shape, np.bool_)
        for _ in range(SPOT_SEARCHES):
            if spots is None or not run.fits(whole.duration_s):
                break
            hidden = hidden | on_sensor(spots.samples, grid)
            if hidden.mean() > MAX_HIDDEN:
                break
            joined = None if joined is None else np.where(hidden, np.float32(np.nan), joined)
            run = run.again(np.where(hidden, np.float32(np.nan), whole.run.counts), joined)
            again = yield from self._again(run)
            if again is None:
                break
            tried.append(again)
            spots = _spots(run)
            if _falls(best, again):
                best, share = again, float(hidden.mean())
        # with bands left something else is wrong with this frame
        if not _falls(whole, best, BETTER, MAX_EXPLAINED) or is_banded(best.made.report.quality):
            return whole.choice(whole, tried)
        row, col = (at + n * grid.n for at, n in zip(grid.first_px, first.largest, strict=True))
        notes = (DUST.format(share=share, row=row, col=col),) if first.are_dark else ()
        return whole.choice(best, tried).with_correction("spots", share, *notes)

    def _behind_pupil(self, whole: Solution) -> Generator[Step, None, Solution]:
        """Return the solution of the frame behind its pupil, if the forward model then explains it."""
        run, residual = whole.run, whole.made.report.residual
        if run.asked.rounds is not None:  # fewer rounds leave a larger residual
            return whole
        is_cut = _is_cut(run)
        is_explained = residual is None or residual <= MAX_EXPLAINED
        if self._solve_behind_pupil is None or (is_explained and not is_cut):
            return whole
        if not run.fits(PUPIL_SOLUTIONS * whole.duration_s):
            return whole
        found = yield from self._solve_behind_pupil(run)
        if found is None:
            return whole
        report = found.made.report
        made = replace(found.made, report=_widened(report, PUPIL_SD_DPT * found.hidden))
        again = Solution(found.run, made)
        if states_misfit(report.warnings) or not _falls(whole, again, 1.0 if is_cut else BETTER, MAX_EXPLAINED):
            return whole.choice(whole, [again])
        return whole.choice(again, [again]).with_correction("pupil", found.hidden, PUPIL.format(share=found.hidden))


def with_corrections(
    made: Reconstruction, found: Mapping[str, float], notes: tuple[str, ...], others_s: float
) -> Reconstruction:
    """Return a picture with its corrections in the report, as in `Solution`."""
    report = made.report
    seconds = report.seconds | ({"correct": report.seconds.get("correct", 0.0) + others_s} if others_s else {})
    quality, warnings = {**report.quality, **found}, (*report.warnings, *notes)
    return replace(made, report=replace(report, seconds=seconds, quality=quality, warnings=warnings))


def widened_by_lines(made: Reconstruction, faults: Mapping[str, float]) -> Reconstruction:
    """Return a picture of a frame without its noise of lines: what is left of it widens the sd of the refraction."""
    report = made.report
    noise_dn, mean_dn = hypot(*(faults.get(name, 0.0) for name in LINE_NOISES)), report.quality.get("mean_dn")
    if not noise_dn or not mean_dn:
        return made
    return replace(made, report=_widened(report, LINES_SD_DPT * noise_dn / mean_dn))


def _widened(report: Report, more_sd_dpt: float) -> Report:
    """Return a report whose refraction has one more standard deviation, with the message about an uncertain one."""
    eye_dpt, doubted = widened(report.refraction_dpt, more_sd_dpt), doubt_of(report.refraction_dpt)
    warnings = (*(words for words in report.warnings if words not in doubted), *doubt_of(eye_dpt))
    return replace(report, refraction_dpt=eye_dpt, warnings=warnings)


def _is_cut(run: FrameRun) -> bool:
    """Return whether the refraction was refused because light is missing from the rim of the PSF."""
    return isinstance(run.refraction, NoRefraction) and run.refraction.is_cut


def _unevenness(run: FrameRun) -> float | None:
    return None if run.diagnostics is None else run.diagnostics.unevenness


def _trace(run: FrameRun, ghost: Ghost | None) -> float:
    """Return the strength of the trace of a ghost in the residual of a run, 0 if it is unknown."""
    trace = None if run.diagnostics is None else run.diagnostics.ghost_trace
    return 0.0 if trace is None or ghost is None else trace.strength_at(ghost.shift)


def _spots(run: FrameRun, least: float = 0.0) -> Spots | None:
    """Return the spots of a solved frame; None without any, or with a residual of at most `least`."""
    known = run.diagnostics
    if known is None or known.find_spots is None or known.residual is None or known.residual <= least:
        return None
    return known.find_spots()


def _falls(before: Solution, after: Solution, to: float = 1.0, most: float = float("inf")) -> bool:
    """Return whether the residual falls below the share `to` of that before, and below `most`; False if unknown."""
    whole, left = before.made.report.residual, after.made.report.residual
    return whole is not None and left is not None and left < min(to * whole, most)


def is_steadier(made: Reconstruction, again: Reconstruction) -> bool:
    """Return whether the forward model explains frames without their flicker better.

    A pattern of horizontal lines in the object looks like flicker, but the forward model explains it. A burst whose
    frames did not match each other is explained better if more of them do.
    """
    before, after = made.report.residual, again.report.residual
    if before is None or after is None:
        return False
    used = [sum(use.used for use in one.report.frames) for one in (made, again)]
    return after < before or (used[1] > used[0] and not is_banded(again.report.quality))
