"""Reconstruction of a frame in stages by regularised deconvolution, anytime within a deadline.

Every stage inverts the forward model y = crop(h * x) + b (`model.forward_model`) with one method of `methods`. The
first stage (by default a coarse quick look) always runs. A later stage, and each round of an iterative solver, starts
only if its measured cost fits into the time that is left.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from math import isfinite
from threading import Lock

import numpy as np

from device.clock import Clock, Deadline
from device.errors import SettingError
from device.recon.assessment.psf_consistency import Consistency, Match, PsfConsistency
from device.recon.assessment.quality_figures import (
    NO_SIGNAL,
    PSF_FIGURES,
    STRUCTURE,
    Audience,
    is_explained,
    is_lit,
    is_measured,
    light_over_noise,
    psf_match,
    quality_warnings,
)
from device.recon.corrections import BehindPupil, Corrections, widened_by_lines, with_corrections
from device.recon.durations import LEAST_RUNS, Pace, RefractionCosts
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
from device.recon.estimation.refraction.notation import doubt_of, report_of, scatter_of
from device.recon.estimation.refraction.task import RefractionTask
from device.recon.estimation.sensor_lines import LineFinder
from device.recon.frame_run import NOTHING, Asked, EyePsf, FrameRun, Known
from device.recon.frames import checked, noise_frame, plane
from device.recon.methods import METHODS, Method, method_named
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.kernels import Pixels, Places
from device.recon.model.resampling import to_sensor
from device.recon.model.spots import without_noise
from device.recon.stage import QuickLook, Recipe, Stage, StageResult, Step, default_schedule
from device.values import Calibration, Image, Reconstruction, Report

Check = Future[Consistency | None]


class Reconstructor:
    """Reconstruction of the frames of one calibration and one sensor shape.

    All planning is done at construction. Not thread-safe: one thread at a time.

    With `refract`, and with known geometry and field, the refraction of the eye is estimated after the
    first stage (before a single one). The later stages use the PSF warped accordingly, or the stored PSF if
    there is no reliable estimate. It is estimated in a thread, and its cylinder, if it fits into the
    deadline, while the picture is solved. The PSF of the picture has the cylinder only if that is known
    before the solution begins: a deadline does not wait for it, nor for a refraction that would cost the
    picture its rounds. The report has what is known when the picture is made.

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
        calibration = without_noise(calibration)
        self.calibration = calibration
        self.shape = shape
        self.clock = clock
        self.psf_index = psf_index
        self._audience = audience
        self._consistency = None if timed else consistency
        pace = Pace()
        with ThreadPoolExecutor(1, "planning") as aside:
            refractor = None
            if refract and can_estimate_refraction(calibration):
                arguments = calibration, shape, planner, psf_index, field_fixed
                refractor = aside.submit(RefractionEstimator, *arguments)
            if timed and refractor is not None:
                wait([refractor])  # the fastest transforms are measured one after the other
            self.stages = [
                Stage(recipe, method_named(recipe.method, methods), calibration, shape, planner, psf_index, pace)
                for recipe in recipes
            ]
            self.defects = DefectFinder(calibration, shape, psf_index)
        self.lines = LineFinder(self.defects.dark, calibration.sensor.white_dn, calibration.psfs[psf_index])
        self.refractor = None if refractor is None else refractor.result()
        self._refraction_lock = Lock()
        plan = partial(Reconstructor, shape=shape, planner=planner, clock=clock, recipes=recipes, psf_index=psf_index)
        replan = partial(plan, timed=False, methods=methods, audience=audience, field_fixed=field_fixed)
        behind = None if self.refractor is None else partial(_solve_behind_pupil, self, replan)
        self.corrections = Corrections(calibration, shape, self.defects.dark, self._solve, behind, pace)
        self._costs = RefractionCosts(pace)
        self._gain = None if self.refractor is None else PsfGain(self.stages[-1].model)
        if timed:
            self._warm_up()
            self._consistency = consistency  # noise needs no check

    def _warm_up(self) -> None:
        """Run on noise to compile the kernels, touch the memory, and then measure the cost of each step.

        Without corrections: each is a solution of its own, and the forward model explains noise with none of them.
        """
        noise = noise_frame(self.calibration, self.shape)

        def solve(dark: Pixels | None = None, rounds: int | None = None, quick: bool = False) -> None:
            counts = self.lines(noise, dark).counts
            asked = Asked(dark, False, rounds, quick, EyePsf.ESTIMATED)
            deque(self._solve(FrameRun(self.stages[0], self.defects, self.clock, asked, counts, None, None)), maxlen=0)

        solve(rounds=1)  # compiles, if the cache of compiled code is empty
        solve(np.zeros_like(noise), quick=True)  # a dark frame selects another compiled signature
        for stage in self.stages:
            stage.forget_costs()
        self._costs = RefractionCosts(self.stages[0].pace)
        for _ in range(LEAST_RUNS):
            solve(rounds=2)
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
        counts, faults, notes = self.lines(checked(counts, self.shape), dark) if look is None else look.even
        asked = Asked(dark, simulated, rounds, quick, eye_psf)
        run = FrameRun(self.stages[0], self.defects, self.clock, asked, counts, joined, deadline)
        made = yield from self._solve(run, Known(refraction, others, look))
        made = yield from self.corrections(run, made)
        yield with_corrections(widened_by_lines(made, faults), faults, notes, others_s=0.0)

    def _solve(self, run: FrameRun, known: Known = NOTHING) -> Generator[Step, None, Reconstruction]:
        """Yield the steps before the picture, and return the picture."""
        asked = run.asked
        task = known.refraction if asked.eye_psf is EyePsf.ESTIMATED else None
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
            yield from run.solve(stage, pauses)
            if check is not None:
                wait([check])
            yield StageResult(stage.recipe, stage.shown, last=stage is self.stages[-1])
        solved_s = self.clock.now_s()
        picture = to_sensor(run.done.picture, run.done.grid)
        finished_s = self.clock.now_s()
        solve_s = solved_s - begin_s - run.refraction_s - run.cylinder_s - run.between_s
        seconds = {"solve": solve_s, "refract": run.refraction_s, "upsample": finished_s - solved_s}
        if task is not None and task.has_found:
            self._take_cylinder(run, task, wait=run.fits(self._costs.cylinder_s))
        if isinstance(run.refraction, Refraction) or run.cylinder_s > 0:
            seconds["cylinder"] = run.cylinder_s
        known_s = self.clock.now_s()
        report = self._report(run, seconds, check)
        if self._consistency is None:  # whose test is outside the deadline
            run.done.finish_cost.add(finished_s - solved_s + self.clock.now_s() - known_s)
        return Reconstruction(picture, report, asked.simulated)

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
        asked = Asked(dark, simulated=False, rounds=None, quick=True, eye_psf=EyePsf.STORED)
        stage = self.stages[0]
        even = self.lines(checked(counts, self.shape), dark)
        run = FrameRun(stage, self.defects, self.clock, asked, even.counts)
        deque(run.solve(stage, pauses=False), maxlen=0)
        assert run.solved is not None
        shown = StageResult(stage.recipe, stage.shown.copy(), last=stage is self.stages[-1])
        return QuickLook(shown, stage.planes.copy(), run.solved, run.found, even)

    def _begin_check(self, run: FrameRun, stage: Stage) -> Check | None:
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
        took = self._costs.find.add
        return RefractionTask(self.refractor, self._refraction_lock, self.clock, frame, with_cylinder, took)

    def _estimate_refraction(
        self, run: FrameRun, task: RefractionTask | None, others: Sequence[Pixels]
    ) -> RefractionTask | None:
        """Estimate the refraction, and set the OTF of the later stages to it, or to that of the stored PSF.

        It begins if it usually leaves the picture its reserved rounds, and is not waited for beyond that. `task`: that
        of the frame, if it has begun. `others`: the other frames of its burst, which are joined without a deadline
        only. Return the task; None without a refractor, or if none has begun.
        """
        begin_s = self.clock.now_s()
        if self.refractor is None:
            return None
        stage, costs = _refracted(self.stages)[0], self._costs
        reserved_s = costs.refocus.seconds + run.cost_s(stage, reserved=True)
        until = None if run.deadline is None else run.deadline.later(-reserved_s)
        if task is None:
            task = self._begin_in_time(run, until)
        eye = None
        if task is not None and task.has_found_by(until) and run.fits(costs.refocus.seconds + run.cost_s(stage)):
            if others and run.deadline is None:
                task.join([self.lines(plane(other, 0), run.asked.dark).counts for other in others])
            run.refraction = task.found()
            self._take_cylinder(run, task, wait=run.deadline is None)
            best = run.refraction if isinstance(run.refraction, Refraction) else task.best()
            eye = best.psf_wavefront if isinstance(best, Refraction) else None
        self._refocus(eye)
        run.refraction_s = self.clock.now_s() - begin_s - run.cylinder_s
        return task

    def _begin_in_time(self, run: FrameRun, until: Deadline | None) -> RefractionTask | None:
        """Begin to estimate the refraction if it usually ends by `until`, and with the cylinder if that does, too."""
        costs = self._costs
        find_s = costs.find.typical_s
        if until is not None and not until.fits(find_s):
            costs.find.skipped(usually_fits=False)
            costs.refocus.skipped(usually_fits=False)
            return None
        with_cylinder = until is None or until.fits(find_s + costs.cylinder_s)
        if not with_cylinder:
            costs.cylinder.skipped(usually_fits=False)
        return self.begin_refraction(*run.brightest(), with_cylinder=with_cylinder)

    def _take_cylinder(self, run: FrameRun, task: RefractionTask, wait: bool) -> None:
        """Set the refraction of the run to that with its cylinder, joined with other frames, as far as it is known.

        With `wait` until all is known, or until the deadline; `cylinder_s` grows by this time.
        """
        begin_s = self.clock.now_s()
        if wait:
            task.is_done_by(None if run.deadline is None else run.deadline.later(-run.done.finish_cost.seconds))
        run.refraction = task.latest()
        if task.is_done and task.cylinder_s > 0:
            self._costs.cylinder.add(task.cylinder_s + task.join_s)
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
            self._costs.refocus.add(self.clock.now_s() - begin_s)

    def _report(self, run: FrameRun, seconds: dict[str, float], check: Check | None) -> Report:
        assert run.solved is not None
        recipe = run.done.recipe
        diagnostics = run.solved.diagnostics
        dark = not run.solved.has_light
        quality = run.solved.quality
        if not run.asked.white:
            quality |= {key: None for key in STRUCTURE if key in quality}
        if run.done.is_closed_form and len(self.stages) == 1:  # no residual, which would show bands: the row means do
            quality |= _flicker_of_rows(self.corrections.flicker, run)
        misfit = diagnostics.residual if isfinite(field_radius_px(self.calibration)) else None
        psf_scale = self._psf_scale(run.done.eye)
        match = psf_match(quality) if dark or self._consistency is None else _checked_match(self, run, quality, check)
        match = _or_far(match, run.refraction, is_explained(quality, match, misfit))
        noise_dn = None if diagnostics.noise_dn is None else diagnostics.noise_dn * recipe.bin
        snr = light_over_noise(run.solved.frame.mean_dn, noise_dn, self.shape) if self.calibration.geometry else None
        warnings = (NO_SIGNAL,) if dark else quality_warnings(quality, match, misfit, self._audience, snr)
        explained = not dark and is_explained(quality, match, misfit)
        eye = _reported_refraction(run.refraction, explained, quality, self.calibration)
        quality |= {
            key: None for key in PSF_FIGURES if key in quality and not (explained and is_measured(key, quality))
        }
        eye_dpt = None if eye is None else report_of(eye, self.calibration.refraction_zero)
        warnings += doubt_of(eye_dpt)
        return Report(
            method=recipe.method,
            bin=recipe.bin,
            rounds=run.rounds_done,
            stopped=run.stopped,
            seconds=seconds,
            psf_index=self.psf_index,
            psf_scale=psf_scale,
            psf_cylinder=self._psf_cylinder(run),
            refraction_dpt=eye_dpt,
            refraction_scatter=scatter_of(eye),
            regularisation=dict(diagnostics.regularisation),
            noise_dn=noise_dn,
            residual=diagnostics.residual,
            quality=quality,
            warnings=warnings,
        )

    def _psf_cylinder(self, run: FrameRun) -> dict[str, float | None] | None:
        """Return `psf_cylinder` of the report: the cylinder of the picture's PSF, and its gain if it is predicted."""
        eye = run.done.eye
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


def _solve_behind_pupil(
    owner: Reconstructor, replan: Callable[[Calibration], Reconstructor], run: FrameRun
) -> Generator[Step, None, BehindPupil | None]:
    """Yield the steps of the frame of a run behind its pupil, and return run and picture; None if none is found."""
    assert owner.refractor is not None
    with owner._refraction_lock:
        pupil = owner.refractor.find_pupil(*run.brightest())
    if pupil is None:
        return None
    psfs = list(owner.calibration.psfs)
    psfs[owner.psf_index], hidden = pupil.hide(psfs[owner.psf_index], owner.refractor.geometry.pitch_um)
    other = replan(replace(owner.calibration, psfs=tuple(psfs)))
    again = FrameRun(other.stages[0], other.defects, other.clock, run.asked, run.counts, None, run.deadline)
    made = yield from other._solve(again)
    return BehindPupil(again, made, hidden)


def _reported_refraction(
    eye: Refraction | NoRefraction | None, explained: bool, quality: dict[str, float | None], calibration: Calibration
) -> Refraction | NoRefraction | None:
    """Return the refraction that the report states: corrected, or refused for a frame that is not explained.

    A field that is too dark shows no edge, and no refraction; behind lenslets any part of it shows the spots.
    """
    if eye is not None and not (explained and (calibration.has_spots or is_lit(quality))):
        return NoRefraction("the forward model does not explain the frame")
    return corrected(eye, calibration.refraction_offset) if isinstance(eye, Refraction) else eye


def _flicker_of_rows(finder: FlickerFinder, run: FrameRun) -> dict[str, float]:
    counts, dark, _ = run.brightest()
    steady = finder(counts, dark)
    return {} if steady is None else {"banding": steady.flicker}


def _checked_match(owner: Reconstructor, run: FrameRun, quality: dict[str, float | None], check: Check | None) -> Match:
    """Return whether frame and PSF match by the consistency test, and add its figures to `quality`."""
    assert owner._consistency is not None
    figures = (
        check.result() if check else owner._consistency(run.counts, owner._psf_scale(run.done.eye), run.known_defects)
    )
    if figures is None:
        return Match.UNKNOWN
    quality |= figures.report_figures
    return figures.match


def _or_far(match: Match, refraction: Refraction | NoRefraction | None, explained: bool) -> Match:
    """Return FOREIGN_OR_FAR for a frame that is not explained, and best at the end of the search for the refraction."""
    is_far = isinstance(refraction, NoRefraction) and refraction.is_far
    is_open = match in (Match.UNKNOWN, Match.FOREIGN, Match.CONSISTENT)  # with a part of the PSF's structure
    return Match.FOREIGN_OR_FAR if is_far and not explained and is_open else match


def _refracted(stages: list[Stage]) -> list[Stage]:
    """Return the stages that use the PSF of the eye."""
    return stages[min(1, len(stages) - 1) :]
