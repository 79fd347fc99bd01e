"""Reconstruction of a frame in stages by regularised deconvolution, anytime within a deadline.

Every stage inverts the forward model y = crop(h * x) + b (`model.forward_model`) with one method of `methods`. The
first stage (by default a coarse quick look) always runs. A later stage, and each round of an iterative solver, starts
only if its measured cost fits into the time that is left.
"""

from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from enum import Enum
from math import isfinite, isinf
from threading import Lock

import numpy as np

from device.clock import Clock, Deadline
from device.errors import FrameError, SettingError
from device.recon.assessment.psf_consistency import Consistency, Match, PsfConsistency
from device.recon.assessment.quality_figures import (
    NO_SIGNAL,
    PSF_FIGURES,
    Audience,
    is_banded,
    is_explained,
    is_lit,
    is_measured,
    light_over_noise,
    psf_match,
    quality_warnings,
    states_misfit,
)
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.flicker import FlickerFinder
from device.recon.estimation.power_law_prior import PowerLaw
from device.recon.estimation.psf_gain import PsfGain
from device.recon.estimation.psf_warp import Wavefront
from device.recon.estimation.refraction.correction import corrected
from device.recon.estimation.refraction.estimator import (
    NoRefraction,
    Refraction,
    RefractionEstimator,
    can_estimate_refraction,
)
from device.recon.estimation.refraction.notation import report_of, scatter_of
from device.recon.estimation.refraction.task import RefractionTask
from device.recon.estimation.sensor_lines import LineFinder
from device.recon.estimation.spots import Spots, on_sensor
from device.recon.estimation.uneven_light import FALLS, UnevenLight
from device.recon.methods import DEFAULT, METHODS, Method, method_named
from device.recon.model.compiled import read_only
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear, Preprocessor
from device.recon.model.resampling import to_sensor
from device.recon.model.resolution import STOPBAND_SHARE, STOPBAND_SHARE_OPEN, working_bin
from device.recon.solvers.solver import Diagnostics, Solver
from device.values import Calibration, Image, Mask, Reconstruction, RefractionOffset, Report, check_image_shape

Check = Future[Consistency | None]
SPOT_SEARCHES = 4
MAX_HIDDEN = 0.15  # share of the sensor: with more the frame is another one
BETTER = 0.9  # of the residual of the whole frame: by chance up to 0.97, dust at 500 electrons 0.78
MAX_EXPLAINED = 1.2  # rms residual of a frame without its spots: 0.86 to 1.0
DUST = (
    "Dark spots, {share:.1%} of the frame, were left out; the largest is at row {row}, column {col} of the sensor. "
    "Clean sensor and diffuser; if they stay, measure the flat frame again."
)
RESERVED_ROUNDS = 6  # kept free for the last stage: half of a picture's rounds give it all but 0.02 dB
CYLINDER_SEARCHES = 6  # most of the duration of a cylinder in searches for M on noise, which end after the coarse one


class EyePsf(Enum):
    """PSF with which the later stages of a frame are solved."""

    ESTIMATED = "of the refraction that is estimated from the frame"
    KEPT = "that of the picture before"
    STORED = "that of the calibration"


@dataclass(frozen=True)
class Recipe:
    """Settings of one stage.

    Attributes
    ----------
    method
        Name of the method.
    bin
        bin x bin sensor pixels become one sample.
    rounds
        Largest number of rounds; None: the default of the method.
    settings
        Names and values of the method's settings; what is not set is chosen from the frame.
    """

    method: str = DEFAULT
    bin: int = 1
    rounds: int | None = None
    settings: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class StageResult:
    """Result of one stage.

    Attributes
    ----------
    recipe
        Settings of the stage.
    picture
        Shown part of its picture, linear, on its grid.
    last
        True for the last stage.
    """

    recipe: Recipe
    picture: Image
    last: bool


@dataclass(frozen=True)
class Solved:
    """The last frame that a solver has solved, and its diagnostics."""

    frame: Linear
    diagnostics: Diagnostics

    @property
    def has_light(self) -> bool:
        """True if there is a signal above the black level."""
        return self.frame.mean_dn > 0 and self.diagnostics.noise_dn != 0

    @property
    def quality(self) -> dict[str, float | None]:
        """Figures of the frame and of the solver by their names in a report."""
        figures = {"saturated": self.frame.saturated, "missing": self.frame.missing, "mean_dn": self.frame.mean_dn}
        return {**figures, **self.diagnostics.quality}


@dataclass(frozen=True)
class QuickLook:
    """The first stage of a frame, from which `Reconstructor.steps` of the same frame goes on.

    Attributes
    ----------
    stage
        Its result.
    planes
        Its whole picture (channels, rows, cols) on its grid.
    solved
        The frame and the diagnostics.
    defects
        Flat indices of the defective pixels of each channel, None if there are none.
    """

    stage: StageResult
    planes: Image
    solved: Solved
    defects: Mapping[int, Places | None]


@dataclass(frozen=True)
class RoundDone:
    """A round of the last stage is done, or a frame of a burst joined: the consumer may do other work meanwhile."""


ROUND_DONE = RoundDone()
Step = StageResult | RoundDone | Reconstruction  # what `Reconstructor.steps` yields
ChannelFrame = tuple[Pixels, Pixels | None, Places | None]  # counts, dark frame, defective pixels


def default_schedule(calibration: Calibration, shape: tuple[int, int], index: int = 0) -> tuple[Recipe, Recipe]:
    """Return the two default stages: a quick look, then the best picture at the resolution of the optics.

    `shape` is (rows, cols) of the sensor, `index` the PSF. With a known field the methods are `evidence` and
    `variation`, otherwise `gradient` and `open`. The second stage uses `working_bin`, reduced until the shorter side
    has at least 64 samples; the first uses twice that bin, or the same if the side would have fewer than 16.
    """
    is_open = isinf(field_radius_px(calibration))
    n = working_bin(calibration.psfs[index], STOPBAND_SHARE_OPEN if is_open else STOPBAND_SHARE)
    while n > 1 and min(shape) // n < 64:
        n -= 1
    coarse = 2 * n if min(shape) // (2 * n) >= 16 else n
    if is_open:
        return Recipe("gradient", coarse), Recipe("open", n)
    return Recipe("evidence", coarse), Recipe("variation", n)


class DurationEstimate:
    """Estimate of the duration of a step in seconds: the maximum of the last 12, some halved since."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=12)

    def add(self, seconds: float) -> None:
        """Add the duration of one run."""
        self._seen.append(seconds)

    @property
    def seconds(self) -> float:
        """Maximum of the stored durations; 0.0 before the first run."""
        return max(self._seen, default=0.0)

    def halve_maximum(self) -> None:
        """Halve the largest stored duration; called when a step was skipped because it would miss the deadline.

        A skipped step records no new duration, so a single slow run would otherwise block the step forever.
        """
        if self._seen:
            self._seen[self._seen.index(self.seconds)] /= 2


class _Stage:
    """Planned resources of one stage: forward model, preprocessor, solver, output arrays and cost estimates."""

    def __init__(
        self,
        recipe: Recipe,
        method: Method,
        calibration: Calibration,
        shape: tuple[int, int],
        planner: Planner,
        index: int,
    ) -> None:
        self.recipe = recipe
        self.is_closed_form = method.rounds == 0
        self.model = method.model(calibration, shape, recipe.bin, planner, index)
        self.grid = self.model.grid
        self.eye: Wavefront | None = None  # of the PSF in use; None: the stored one
        self.solver: Solver = method.solver(self.model, calibration, planner, dict(recipe.settings))
        self.preparer = Preprocessor(calibration, self.grid, self.solver.input_buffer)
        self.joined_preparer = Preprocessor(without_sensor(calibration), self.grid, self.solver.input_buffer)
        self.most = method.rounds if recipe.rounds is None else recipe.rounds
        self.planes: Image = np.zeros((1, *self.grid.shape), np.float32)
        self.start_cost = DurationEstimate()
        self.round_cost = DurationEstimate()
        self.end_cost = DurationEstimate()  # of the solver, for one channel
        self.finish_cost = DurationEstimate()  # of the picture on the sensor's grid, for all

    def refocus(self, otf: Spectrum, eye: Wavefront | None) -> None:
        """Use `otf`, the OTF of the PSF of `eye`, from the next `solver.start` on; no-op if in use."""
        self.eye = eye
        if otf is not self.model.otf:
            self.model.refocus(otf)
            self.solver.refocus()

    @property
    def picture(self) -> Image:
        """Last solution: (rows, cols) or (rows, cols, 3) of the grid."""
        return self.planes[0] if len(self.planes) == 1 else np.moveaxis(self.planes, 0, -1)

    @property
    def least_s(self) -> float:
        """Estimated minimum duration for one channel, seconds: start, one round, end and finish."""
        ends_s = self.end_cost.seconds + self.finish_cost.seconds
        return self.start_cost.seconds + self.round_cost.seconds + ends_s

    @property
    def reserved_s(self) -> float:
        """Estimated duration for one channel with the rounds that refraction and joining must leave time for."""
        return self.least_s + max(min(RESERVED_ROUNDS, self.most) - 1, 0) * self.round_cost.seconds

    def halve_costs(self) -> None:
        """Halve the cost estimates after the stage was skipped; one slow run would otherwise block it forever."""
        for cost in (self.start_cost, self.round_cost, self.end_cost, self.finish_cost):
            cost.halve_maximum()

    @property
    def shown(self) -> Image:
        """The field of view in the picture: `picture` cropped to `grid.shown`."""
        return self.picture[self.grid.shown]


class Reconstructor:
    """Reconstruction of the frames of one calibration and one sensor shape.

    All planning is done at construction. Not thread-safe: one thread at a time.

    With `refract`, and with known geometry and field, the refraction of the eye is estimated after the
    first stage (before a single one). The later stages use the PSF warped accordingly, or the stored PSF if
    there is no reliable estimate. It is estimated in a thread, and its cylinder, if it fits into the
    deadline, while the picture is solved. The PSF of the picture has the cylinder only if that is known
    before the solution begins: a deadline does not wait for it.

    Parameters
    ----------
    calibration
        Calibration of the head.
    shape
        (rows, cols) of the sensor in pixels.
    planner
        Planner of the FFTs.
    clock
        Clock of the durations and deadlines.
    recipes
        Stages in their order; the last gives the final picture, the earlier ones quick looks. Empty:
        `default_schedule`.
    psf_index
        Index of the PSF in the calibration.
    refract
        True: estimate the refraction of the eye.
    consistency
        Test of the PSF on each frame, outside the deadline (for files); None: no test.
    timed
        True: measure the cost of every step on noise, before the first deadline. False saves this time
        where no deadline is used.
    methods
        Table in which the recipes' methods are looked up.
    audience
        Reader of the warnings.
    field_fixed
        True: the field of the calibration is exact.

    Raises
    ------
    SettingError
        A bin is below 1, or the table does not have a method.
    """

    def __init__(
        self,
        calibration: Calibration,
        shape: tuple[int, int],
        planner: Planner,
        clock: Clock,
        recipes: tuple[Recipe, ...] = (),
        psf_index: int = 0,
        refract: bool = True,
        consistency: PsfConsistency | None = None,
        timed: bool = True,
        methods: Mapping[str, Method] = METHODS,
        audience: Audience = Audience.OPERATOR,
        field_fixed: bool = False,
    ) -> None:
        recipes = recipes or default_schedule(calibration, shape, psf_index)
        if min(recipe.bin for recipe in recipes) < 1:
            raise SettingError("a sample is made of at least one pixel")
        self.calibration = calibration
        self.shape = shape
        self.clock = clock
        self.psf_index = psf_index
        self._audience = audience
        self._consistency = None if timed else consistency
        with ThreadPoolExecutor(1, "planning") as aside:
            refractor = None
            if refract and can_estimate_refraction(calibration):
                arguments = calibration, shape, planner, psf_index, field_fixed
                refractor = aside.submit(RefractionEstimator, *arguments)
            if timed and refractor is not None:
                wait([refractor])  # the fastest transforms are measured one after the other
            self.stages = [
                _Stage(recipe, method_named(recipe.method, methods), calibration, shape, planner, psf_index)
                for recipe in recipes
            ]
            self.defects = DefectFinder(calibration, shape, psf_index)
        self.flicker = FlickerFinder(self.defects.dark, calibration.sensor.white_dn)
        self.lines = LineFinder(self.defects.dark, calibration.sensor.white_dn, calibration.psfs[psf_index])
        self.refractor = None if refractor is None else refractor.result()
        self._refraction_lock = Lock()
        self._find_cost = DurationEstimate()
        self._refocus_cost = DurationEstimate()
        self._cylinder_cost = DurationEstimate()
        self._gain = None if self.refractor is None else PsfGain(self.stages[-1].model)
        if timed:
            self._warm_up()
            self._consistency = consistency  # noise needs no check

    def _warm_up(self) -> None:
        """Run on noise to compile the kernels, touch the memory, and then measure the cost of each step."""
        noise = noise_frame(self.calibration, self.shape)
        self(noise, rounds=1)  # compiles, if the cache of compiled code is empty
        self(noise, np.zeros_like(noise), quick=True)  # a dark frame selects another compiled signature
        for stage in self.stages:
            stage.start_cost = DurationEstimate()
            stage.round_cost = DurationEstimate()
            stage.end_cost = DurationEstimate()
            stage.finish_cost = DurationEstimate()
        self._find_cost = DurationEstimate()
        self._cylinder_cost = DurationEstimate()
        self(noise, rounds=2)
        for eye in (Wavefront(1.0), None):
            self._refocus(eye)

    def __call__(
        self,
        counts: Pixels,
        dark: Pixels | None = None,
        *,
        simulated: bool = False,
        deadline: Deadline | None = None,
        rounds: int | None = None,
        quick: bool = False,
    ) -> Reconstruction:
        """Return the best picture that fits into the deadline, and its report: the last one of `steps`.

        Parameters
        ----------
        counts
            Counts, uint16 or float32, (rows, cols) or (rows, cols, 3).
        dark
            Dark frame of the same shape; None: that of the calibration.
        simulated
            Mark that is copied to the result.
        deadline
            Time by which the picture is needed; None: all rounds.
        rounds
            Largest number of rounds of every stage.
        quick
            True: only the first stage.

        Returns
        -------
        Reconstruction
            Linear float32, (rows, cols) or (rows, cols, 3) of the sensor, and its report.

        Raises
        ------
        FrameError
            The frame has another shape than the sensor, too many pixels are missing, or rows are repeated or missing.
        """
        steps = self.steps(counts, dark, simulated=simulated, deadline=deadline, rounds=rounds, quick=quick)
        (picture,) = deque(steps, maxlen=1)
        assert isinstance(picture, Reconstruction)
        return picture

    def steps(
        self,
        counts: Pixels,
        dark: Pixels | None = None,
        *,
        simulated: bool = False,
        deadline: Deadline | None = None,
        rounds: int | None = None,
        quick: bool = False,
        joined: Image | None = None,
        eye_psf: EyePsf = EyePsf.ESTIMATED,
        refraction: RefractionTask | None = None,
        others: Sequence[Pixels] = (),
        look: QuickLook | None = None,
    ) -> Iterator[Step]:
        """Yield the result of each stage, then the best picture that fits into the deadline, with its report.

        The first stage always runs. With several stages a ROUND_DONE follows each round of the last one. The
        deadline moves by the time until the iteration continues, and meanwhile this reconstructor may be called
        with `quick`.

        Parameters
        ----------
        counts
            Counts, uint16 or float32, (rows, cols) or (rows, cols, 3).
        dark
            Dark frame of the same shape; None: that of the calibration.
        simulated
            Mark that is copied to the result.
        deadline
            Time by which the picture is needed; None: all rounds.
        rounds
            Largest number of rounds of every stage.
        quick
            True: only the first stage.
        joined
            Sum of a burst, which the later stages solve instead of `counts`: linear DN above dark with the gain
            of the sensor, NaN for missing pixels.
        eye_psf
            PSF of the later stages.
        refraction
            Task of this frame, if it has begun.
        others
            Other frames of its burst, which the refraction takes into account; not with a `deadline`.
        look
            Quick look of this frame with this dark frame, if there is one: the first of several stages is not solved
            again.

        Yields
        ------
        StageResult, RoundDone or Reconstruction
            The last one is the picture, linear float32, (rows, cols) or (rows, cols, 3) of the sensor.

        Raises
        ------
        FrameError
            The frame has another shape than the sensor, too many pixels are missing (`Preprocessor`), or rows are
            repeated or missing (`RowOrder`).
        """
        asked = _Asked(simulated, quick, joined, eye_psf)
        counts, noise = self.lines(checked(counts, self.shape), dark)
        run = _Run(self, counts, dark, deadline, rounds)
        begin_s = self.clock.now_s()
        made = yield from self._solve(run, asked, _Known(refraction, others, look))
        solving_s = self.clock.now_s() - begin_s - run.between_s
        can_tell = joined is None and not run.done.is_closed_form  # whether another frame is explained better
        if can_tell and is_banded(made.report.quality) and run.fits(solving_s):
            steady = self.flicker(counts, dark)
            if steady is not None:
                other = _Run(self, steady.counts, dark, run.deadline, rounds)
                again = yield from _solved_again(self, other, asked)
                better = made if again is None else steadier(made, again, steady.flicker)
                made, run = (made, run) if better is made else (better, other)
        light = None
        if can_tell:
            run, made, light = yield from _in_even_light(self, run, asked, made, solving_s)
        made = yield from _without_spots(self, run, asked, made, solving_s)
        made = made if light is None else _with_light_reported(made, light)
        yield replace(made, report=replace(made.report, quality=made.report.quality | noise)) if noise else made

    def _solve(self, run: "_Run", asked: "_Asked", known: "_Known") -> Generator[Step, None, Reconstruction]:
        """Yield the steps before the picture, and return the picture."""
        task = known.refraction
        check: Check | None = None
        begin_s = self.clock.now_s()
        stages = self.stages[:1] if asked.quick else self.stages
        if known.look is not None and len(stages) > 1:
            run.begin_with(stages[0], known.look)
            yield known.look.stage
            stages = stages[1:]
        for stage in stages:
            if stage is _refracted(self.stages)[0] and not asked.quick and asked.eye_psf is EyePsf.ESTIMATED:
                task = self._estimate_refraction(run, task, known.others)
            elif stage is _refracted(self.stages)[0] and asked.eye_psf is EyePsf.STORED:
                self._refocus(None)
            if not run.has_time_for(stage):
                break
            check = self._begin_check(run, stage)
            pauses = stage is self.stages[-1] and len(self.stages) > 1
            yield from run.solve(stage, pauses, None if stage is self.stages[0] else asked.joined)
            if check is not None:
                wait([check])
            yield StageResult(stage.recipe, stage.shown, last=stage is self.stages[-1])
        solved_s = self.clock.now_s()
        picture = to_sensor(run.done.picture, run.done.grid)
        finished_s = self.clock.now_s()
        run.done.finish_cost.add(finished_s - solved_s)
        solve_s = solved_s - begin_s - run.refraction_s - run.cylinder_s - run.between_s
        seconds = {"solve": solve_s, "refract": run.refraction_s, "upsample": finished_s - solved_s}
        if task is not None and isinstance(run.refraction, Refraction):
            self._take_cylinder(run, task, wait=run.fits(self._cylinder_s))
        if isinstance(run.refraction, Refraction) or run.cylinder_s > 0:
            seconds["cylinder"] = run.cylinder_s
        return Reconstruction(picture, self._report(run, seconds, check), asked.simulated)

    def quick_look(self, counts: Pixels, dark: Pixels | None = None) -> QuickLook:
        """Return the first stage of a frame, for `steps` of this frame.

        Parameters
        ----------
        counts
            Counts, uint16 or float32, (rows, cols) or (rows, cols, 3).
        dark
            Dark frame of the same shape; None: that of the calibration.

        Returns
        -------
        QuickLook
            The first stage.

        Raises
        ------
        FrameError
            As `steps`.
        """
        run = _Run(self, self.lines(checked(counts, self.shape), dark).counts, dark, None, None)
        stage = self.stages[0]
        deque(run.solve(stage, pauses=False, joined=None), maxlen=0)
        assert run.solved is not None
        shown = StageResult(stage.recipe, stage.shown.copy(), last=stage is self.stages[-1])
        return QuickLook(shown, stage.planes.copy(), run.solved, run.found)

    def _begin_check(self, run: "_Run", stage: _Stage) -> Check | None:
        """Begin the PSF consistency check of a frame of one stage in a thread, beside its solver; not with a deadline.

        Several stages pause between rounds, where a call for another frame may use the check.
        """
        if self._consistency is None or run.deadline is not None or len(self.stages) > 1:
            return None
        for c in range(run.channels):
            run.channel(c)  # finds the defects
        aside = ThreadPoolExecutor(1, "psf-consistency")
        check = aside.submit(self._consistency, run.counts, self._psf_scale(stage.eye), run.known_defects)
        aside.shutdown(wait=False)
        return check

    def _psf_scale(self, eye: Wavefront | None) -> float:
        """Return the scale of the stored PSF for an eye: 1 for none."""
        return 1.0 if self.refractor is None or eye is None else self.refractor.scale(eye.m_dpt)

    def begin_refraction(
        self, counts: Pixels, dark: Pixels | None = None, defects: Places | None = None, *, with_cylinder: bool = True
    ) -> RefractionTask | None:
        """Begin to estimate the refraction of a frame in a thread.

        The task is for `steps` of this frame, with the same dark frame.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        defects
            Flat indices of defective pixels, which are left out.
        with_cylinder
            True: estimate the cylinder, too.

        Returns
        -------
        RefractionTask or None
            None if the calibration permits no estimate.
        """
        if self.refractor is None:
            return None
        frame = counts, dark, defects
        return RefractionTask(self.refractor, self._refraction_lock, self.clock, frame, with_cylinder)

    def _estimate_refraction(
        self, run: "_Run", task: RefractionTask | None, others: Sequence[Pixels]
    ) -> RefractionTask | None:
        """Estimate the refraction if time is left; set the OTF of the later stages to it, or to the stored PSF's.

        `task`: that of the frame, if it has begun: once it has found the refraction, the estimate takes no time.
        `others`: the other frames of its burst, which are joined without a deadline only. Return the task, None without
        a refractor; without time `task` as it is.
        """
        begin_s = self.clock.now_s()
        eye = None
        if self.refractor is None:
            return None
        find_s = 0.0 if task is not None and task.has_found else self._find_cost.seconds
        cost_s = find_s + self._refocus_cost.seconds + run.reserved_s(_refracted(self.stages)[0])
        if run.fits(cost_s):
            with_cylinder = run.fits(cost_s + self._cylinder_s)
            if not with_cylinder:
                self._cylinder_cost.halve_maximum()
            task = task or self.begin_refraction(*run.brightest(), with_cylinder=with_cylinder)
            assert task is not None
            if others and run.deadline is None:
                task.join([self.lines(plane(other, 0), run.dark).counts for other in others])
            run.refraction = task.found()
            self._find_cost.add(task.find_s)
            self._take_cylinder(run, task, wait=run.deadline is None)
            best = run.refraction if isinstance(run.refraction, Refraction) else task.best()
            eye = best.psf_wavefront if isinstance(best, Refraction) else None
        else:
            max(self._find_cost, self._refocus_cost, key=lambda cost: cost.seconds).halve_maximum()
        self._refocus(eye)
        run.refraction_s = self.clock.now_s() - begin_s - run.cylinder_s
        return task

    @property
    def _cylinder_s(self) -> float:
        """Estimated duration of the search for a cylinder and of the joining with other frames in seconds."""
        return max(self._cylinder_cost.seconds, CYLINDER_SEARCHES * self._find_cost.seconds)

    def _take_cylinder(self, run: "_Run", task: RefractionTask, wait: bool) -> None:
        """Set the refraction of the run to that with its cylinder, joined with other frames, as far as it is known.

        With `wait` until all is known; `cylinder_s` grows by this time.
        """
        begin_s = self.clock.now_s()
        run.refraction = task.whole() if wait else task.latest()
        if task.is_done and task.cylinder_s > 0:
            self._cylinder_cost.add(task.cylinder_s + task.join_s)
        if wait:
            run.cylinder_s += self.clock.now_s() - begin_s

    def _refocus(self, eye: Wavefront | None) -> None:
        """Set the OTF of the later stages to that of an eye; None selects the stored PSF."""
        if self.refractor is None:
            return
        begin_s = self.clock.now_s()
        for stage in _refracted(self.stages):
            stage.refocus(stage.model.stored if eye is None else self.refractor.otf(stage.model, eye), eye)
        if eye is not None:
            self._refocus_cost.add(self.clock.now_s() - begin_s)

    def _report(self, run: "_Run", seconds: dict[str, float], check: Check | None) -> Report:
        assert run.solved is not None
        recipe = run.done.recipe
        diagnostics = run.solved.diagnostics
        dark = not run.solved.has_light
        quality = run.solved.quality
        if run.done.is_closed_form and len(self.stages) == 1:  # no residual, which would show bands: the row means do
            quality |= _flicker_of_rows(self.flicker, run)
        misfit = diagnostics.residual if isfinite(field_radius_px(self.calibration)) else None
        psf_scale = self._psf_scale(run.eye)
        match = psf_match(quality) if dark or self._consistency is None else _checked_match(self, run, quality, check)
        match = _or_far(match, run.refraction, is_explained(quality, match, misfit))
        noise_dn = None if diagnostics.noise_dn is None else diagnostics.noise_dn * recipe.bin
        snr = light_over_noise(run.solved.frame.mean_dn, noise_dn, self.shape) if self.calibration.geometry else None
        warnings = (NO_SIGNAL,) if dark else quality_warnings(quality, match, misfit, self._audience, snr)
        explained = not dark and is_explained(quality, match, misfit)
        eye = _reported_refraction(run.refraction, explained and is_lit(quality), self.calibration.refraction_offset)
        quality |= {
            key: None for key in PSF_FIGURES if key in quality and not (explained and is_measured(key, quality))
        }
        if isinstance(eye, Refraction) and (abs(eye.m_dpt) > 8 or eye.sd_dpt > 0.5):
            warnings += (f"The refraction of {-eye.m_dpt:+.1f} dpt (sd {eye.sd_dpt:.1f}) is uncertain.",)
        return Report(
            method=recipe.method,
            bin=recipe.bin,
            rounds=run.rounds_done,
            stopped=run.stopped,
            seconds=seconds,
            psf_index=self.psf_index,
            psf_scale=psf_scale,
            psf_cylinder=self._psf_cylinder(run),
            refraction_dpt=None if eye is None else report_of(eye),
            refraction_scatter=scatter_of(eye),
            regularisation=dict(diagnostics.regularisation),
            noise_dn=noise_dn,
            residual=diagnostics.residual,
            quality=quality,
            warnings=warnings,
        )

    def _psf_cylinder(self, run: "_Run") -> dict[str, float | None] | None:
        """Return `psf_cylinder` of the report: the cylinder of the picture's PSF, and its gain if it is predicted."""
        eye = run.eye
        stage = run.done
        if eye is None or eye == Wavefront(eye.m_dpt) or self.refractor is None or self._gain is None:
            return None
        assert run.solved is not None
        figures = run.solved.diagnostics.regularisation
        noise_dn = run.solved.diagnostics.noise_dn
        log_power = figures.get("prior_log_power")
        slope = figures.get("prior_slope")
        gain_db = None
        if log_power is not None and slope is not None and noise_dn:
            other = self.refractor.otf(stage.model, Wavefront(eye.m_dpt))
            gain_db = self._gain(stage.model.otf, other, PowerLaw(log_power, slope), noise_dn)
        return {"j0_dpt": -eye.j0_dpt, "j45_dpt": eye.j45_dpt, "gain_db": gain_db}


def _reported_refraction(
    eye: Refraction | NoRefraction | None, explained: bool, offset: RefractionOffset | None
) -> Refraction | NoRefraction | None:
    """Return the refraction that the report states: corrected, or refused for a frame that is not explained."""
    if eye is not None and not explained:
        return NoRefraction("the forward model does not explain the frame")
    return corrected(eye, offset) if isinstance(eye, Refraction) else eye


def _solved_again(owner: Reconstructor, run: "_Run", asked: "_Asked") -> Generator[Step, None, Reconstruction | None]:
    """Yield the steps of a corrected frame, and return its picture; None if too little of the frame is left.

    The picture that was made of the whole frame then stays.
    """
    try:
        return (yield from owner._solve(run, asked, _Known()))
    except FrameError:
        return None


def _in_even_light(
    owner: Reconstructor, run: "_Run", asked: "_Asked", made: Reconstruction, solving_s: float
) -> Generator[Step, None, tuple["_Run", Reconstruction, UnevenLight | None]]:
    """Yield the steps of the frame as in even light; return its run and picture if the forward model explains it much
    better, else `run` and `made`; and the light that was taken out.

    Each correction takes `solving_s`, and none begins after the deadline.
    """
    before, residual = _unevenness(run), made.report.residual
    if before is None or residual is None or run.diagnostics is None:
        return run, made, None
    _, dark, _ = run.channel(0)
    offset = owner.defects.dark if dark is None else np.asarray(dark, np.float32)
    grid, white_dn = run.done.grid, owner.calibration.sensor.white_dn
    for light in run.diagnostics.uneven:
        if not run.fits(solving_s):
            break
        even = light.without(run.counts, offset, white_dn, grid)
        other = _Run(owner, even, run.dark, run.deadline, run.most)
        again = yield from _solved_again(owner, other, asked)
        after = _unevenness(other)
        if again is None or after is None or again.report.residual is None:
            continue
        is_better = after < FALLS * before and again.report.residual < residual
        if is_better and not states_misfit(again.report.warnings):
            known = {key: made.report.quality[key] for key in ("flicker",) if key in made.report.quality}
            report = replace(again.report, quality=again.report.quality | known)
            return other, replace(again, report=report), light
    return run, made, None


def _unevenness(run: "_Run") -> float | None:
    return None if run.diagnostics is None else run.diagnostics.unevenness


def _spots(run: "_Run") -> Spots | None:
    return None if run.diagnostics is None else run.diagnostics.spots


def _with_light_reported(made: Reconstruction, light: UnevenLight) -> Reconstruction:
    """Return the picture with the size and the message of the light that was taken out in its report."""
    report = made.report
    quality = report.quality | {light.key: light.share}
    return replace(made, report=replace(report, quality=quality, warnings=(*report.warnings, light.words)))


def _without_spots(
    owner: Reconstructor, run: "_Run", asked: "_Asked", made: Reconstruction, solving_s: float
) -> Generator[Step, None, Reconstruction]:
    """Yield the steps of the frame without its spots; return its picture if the forward model explains it, else `made`.

    The first residual shows the largest spots only, beside errors that they cause around them: each search is one of
    the frame without the spots found before. Every search takes `solving_s`, and none begins after the deadline.
    """
    first = spots = _spots(run)
    if first is None:
        return made
    counts, joined, best, share = run.counts, asked.joined, made, 0.0
    grid = run.done.grid  # of the spots; a later solution may end after its quick look, on another grid
    hidden: Mask = np.zeros(owner.shape, np.bool_)
    for _ in range(SPOT_SEARCHES):
        if spots is None or not run.fits(solving_s):
            break
        hidden = hidden | on_sensor(spots.samples, grid)
        if hidden.mean() > MAX_HIDDEN:
            break
        asked = replace(asked, joined=None if joined is None else np.where(hidden, np.float32(np.nan), joined))
        run = _Run(owner, np.where(hidden, np.float32(np.nan), counts), run.dark, run.deadline, run.most)
        again = yield from _solved_again(owner, run, asked)
        if again is None:
            break
        spots = _spots(run)
        if again.report.residual is not None and again.report.residual < (best.report.residual or 0.0):
            best, share = again, float(hidden.mean())
    before, after = made.report.residual, best.report.residual
    if before is None or after is None or after >= min(BETTER * before, MAX_EXPLAINED):
        return made
    if is_banded(best.report.quality):  # something else is wrong with this frame
        return made
    report = best.report
    row, col = (at + n * grid.n for at, n in zip(grid.first_px, first.largest, strict=True))
    notes = (DUST.format(share=share, row=row, col=col),) if first.are_dark else ()
    known = {"flicker": made.report.quality["flicker"]} if "flicker" in made.report.quality else {}
    quality = report.quality | known | {"spots": share}
    return replace(best, report=replace(report, quality=quality, warnings=(*report.warnings, *notes)))


def _flicker_of_rows(finder: FlickerFinder, run: "_Run") -> dict[str, float]:
    counts, dark, _ = run.brightest()
    steady = finder(counts, dark)
    return {} if steady is None else {"banding": steady.flicker}


def steadier(made: Reconstruction, again: Reconstruction, flicker: float) -> Reconstruction:
    """Return the picture of frames without their flicker if the forward model explains that one better, else `made`.

    A pattern of horizontal lines in the object looks like flicker, but the forward model explains it. A burst whose
    frames did not match each other is explained better if more of them do.
    """
    before, after = made.report.residual, again.report.residual
    if before is None or after is None:
        return made
    used = [sum(use.used for use in one.report.frames) for one in (made, again)]
    if after >= before and (used[1] <= used[0] or is_banded(again.report.quality)):
        return made
    report = again.report
    seconds = report.seconds | {"solve": made.report.seconds["solve"] + report.seconds["solve"]}
    return replace(again, report=replace(report, seconds=seconds, quality=report.quality | {"flicker": flicker}))


def _checked_match(owner: Reconstructor, run: "_Run", quality: dict[str, float | None], check: Check | None) -> Match:
    """Return whether frame and PSF match by the consistency test, and add its figures to `quality`."""
    assert owner._consistency is not None
    figures = check.result() if check else owner._consistency(run.counts, owner._psf_scale(run.eye), run.known_defects)
    if figures is None:
        return Match.UNKNOWN
    quality |= figures.report_figures
    return figures.match


def _or_far(match: Match, refraction: Refraction | NoRefraction | None, explained: bool) -> Match:
    """Return FOREIGN_OR_FAR for a frame that is not explained, and best at the end of the search for the refraction."""
    is_far = isinstance(refraction, NoRefraction) and refraction.is_far
    return Match.FOREIGN_OR_FAR if is_far and not explained and match in (Match.UNKNOWN, Match.FOREIGN) else match


@dataclass(frozen=True)
class _Asked:
    """What `Reconstructor.steps` was asked for, beside the frame."""

    simulated: bool
    quick: bool
    joined: Image | None
    eye_psf: EyePsf


@dataclass(frozen=True)
class _Known:
    """What is known of a frame before it is solved."""

    refraction: RefractionTask | None = None
    others: Sequence[Pixels] = ()
    look: QuickLook | None = None


class _Run:
    """State of the reconstruction of one frame."""

    def __init__(
        self, owner: Reconstructor, counts: Pixels, dark: Pixels | None, deadline: Deadline | None, most: int | None
    ) -> None:
        self.clock = owner.clock
        self.counts = counts
        self.dark = dark
        self._defects = owner.defects
        self.found: dict[int, Places | None] = {}
        self.deadline = deadline
        self.most = most
        self.done: _Stage = owner.stages[0]
        self.solved: Solved | None = None  # None before the first stage
        self.rounds_done = 0
        self.stopped = "done"
        self.refraction: Refraction | NoRefraction | None = None
        self.refraction_s = self.cylinder_s = self.between_s = 0.0
        self.eye: Wavefront | None = None  # of the PSF of the last stage

    @property
    def channels(self) -> int:
        """Number of channels of the frame."""
        return 1 if self.counts.ndim == 2 else self.counts.shape[2]

    def fits(self, cost_s: float) -> bool:
        """Return True if a step of `cost_s` seconds fits into the time left, or if there is no deadline."""
        return self.deadline is None or self.deadline.fits(cost_s)

    def cost_s(self, stage: _Stage) -> float:
        """Return the minimum duration of a stage in seconds: start, one round and finish, for all channels."""
        return self.channels * stage.least_s - (self.channels - 1) * stage.finish_cost.seconds

    def reserved_s(self, stage: _Stage) -> float:
        """Return the duration of a stage for all channels that is kept free before the refraction begins."""
        return self.cost_s(stage) + self.channels * (stage.reserved_s - stage.least_s)

    @property
    def diagnostics(self) -> Diagnostics | None:
        """Diagnostics of a frame of one channel, which tell what its picture does not explain."""
        return None if self.solved is None or self.channels > 1 else self.solved.diagnostics

    def brightest(self) -> ChannelFrame:
        """Return counts, dark frame and defective pixels of the channel with the highest mean count."""
        return self.channel(0 if self.channels == 1 else int(np.argmax(np.nanmean(self.counts, axis=(0, 1)))))

    def channel(self, c: int) -> ChannelFrame:
        """Return counts, dark frame (or None) and defective pixels of channel `c`; defects are searched only once."""
        counts = plane(self.counts, c)
        dark = None if self.dark is None else plane(self.dark, c)
        if c not in self.found:
            self.found[c] = self._defects(counts, dark)
        return counts, dark, self.found[c]

    @property
    def known_defects(self) -> Places | None:
        """Flat indices of the pixels that are defective in at least one solved channel; None if there are none."""
        found = [places for places in self.found.values() if places is not None]
        return np.unique(np.concatenate(found)) if found else None

    def begin_with(self, stage: _Stage, look: QuickLook) -> None:
        """Take over the first stage of this frame, solved before."""
        stage.planes = look.planes.copy()
        self.found = dict(look.defects)
        self.done = stage
        self.solved = look.solved

    def has_time_for(self, stage: _Stage) -> bool:
        """Return whether a stage runs: the first one always, a later one if there is time; else record the reason."""
        if self.solved is not None and not self.fits(self.cost_s(stage)):
            self.stopped = "deadline"
            stage.halve_costs()
            return False
        return True

    def solve(self, stage: _Stage, pauses: bool, joined: Image | None) -> Iterator[RoundDone]:
        """Solve one stage, channel by channel; with `pauses` yield ROUND_DONE after each round.

        With `joined` this linear frame is solved instead of the counts.
        """
        if len(stage.planes) != self.channels:
            stage.planes = np.zeros((self.channels, *stage.grid.shape), np.float32)
        for c in range(self.channels):
            yield from self._channel(stage, c, pauses, joined)
        self.done = stage
        self.eye = stage.eye

    def _channel(self, stage: _Stage, c: int, pauses: bool, joined: Image | None) -> Iterator[RoundDone]:
        """Solve one channel of a stage; the diagnostics of the last channel are those of the frame."""
        begin_s = self.clock.now_s()
        if joined is None:
            frame = stage.preparer(*self.channel(c))
        else:
            assert self.solved is not None  # a joined frame has no limit: the share is that of its first frame
            saturated = self.solved.frame.saturated
            frame = replace(stage.joined_preparer(plane(joined, c)), saturated=saturated)
        stage.solver.start(frame)
        now_s = self.clock.now_s()
        stage.start_cost.add(now_s - begin_s)
        self.stopped = "done"
        most = stage.most if self.most is None else min(self.most, stage.most)
        self.rounds_done = 0
        while self.rounds_done < most and not stage.is_closed_form:
            if not self._fits_another(stage, self.channels - c):
                self.stopped = "deadline"
                break
            begin_s = now_s
            stage.solver.step()
            now_s = self.clock.now_s()
            stage.round_cost.add(now_s - begin_s)
            self.rounds_done += 1
            if pauses:
                yield ROUND_DONE
                now_s = self._resume(now_s)
        begin_s = self.clock.now_s()
        stage.solver.finish(stage.planes[c])
        stage.end_cost.add(self.clock.now_s() - begin_s)
        self.solved = Solved(frame, stage.solver.diagnostics)

    def _resume(self, paused_s: float) -> float:
        """Move the deadline by the duration of a pause that began at `paused_s`, and return the present time."""
        now_s = self.clock.now_s()
        self.between_s += now_s - paused_s
        if self.deadline is not None:
            self.deadline = self.deadline.later(now_s - paused_s)
        return now_s

    def _fits_another(self, stage: _Stage, channels_left: int) -> bool:
        """Return True if one more round fits, with time for the remaining channels (as many rounds) and the finish."""
        if self.deadline is None:
            return True
        rounds_s = (self.rounds_done + 1) * stage.round_cost.seconds
        others_s = (channels_left - 1) * (stage.start_cost.seconds + rounds_s + stage.end_cost.seconds)
        ends_s = stage.end_cost.seconds + stage.finish_cost.seconds
        return self.deadline.fits(stage.round_cost.seconds + others_s + ends_s)


def checked(counts: Pixels, shape: tuple[int, int]) -> Pixels:
    """Return the counts, (rows, cols) or (rows, cols, 3); FrameError for other rows and columns than `shape`."""
    check_image_shape(counts.shape)
    if counts.shape[:2] != shape:
        raise FrameError(f"the frame has {counts.shape[:2]} pixels, the calibration {shape}", "Use the head's own PSF.")
    return counts


def _refracted(stages: list[_Stage]) -> list[_Stage]:
    """Return the stages that use the PSF of the eye."""
    return stages[min(1, len(stages) - 1) :]


def noise_frame(calibration: Calibration, shape: tuple[int, int]) -> Pixels:
    """Return noise of `shape` below the white level: 100 to 200 DN, or less, as float32, for a level of 200 or less."""
    noise = np.random.default_rng(0).integers(100, 200, shape, dtype=np.uint16)
    white_dn = calibration.sensor.white_dn
    return noise if white_dn > 200 else noise * np.float32(white_dn / 256)


def without_sensor(calibration: Calibration) -> Calibration:
    """Return the calibration for linear frames above dark: no level, no bend, no dark and flat frame, no bad pixels."""
    sensor = replace(calibration.sensor, black_dn=0.0, white_dn=float("inf"), bend_per_dn=0.0)
    return replace(calibration, sensor=sensor, dark_dn=None, flat=None, bad=None)


def plane(image: Pixels, c: int) -> Pixels:
    """Return channel `c` of (rows, cols, 3), or a whole (rows, cols) image, as a contiguous read-only array.

    uint16 is kept, any other type becomes float32; the caller's array stays writeable.
    """
    image = image if image.ndim == 2 else image[..., c]
    if image.dtype == np.uint16:
        return read_only(np.ascontiguousarray(image, np.uint16))
    return read_only(np.ascontiguousarray(image, np.float32))
