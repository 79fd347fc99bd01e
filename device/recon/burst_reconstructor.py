"""Reconstruction of the bursts of an instrument: quick look of the first frame, joined frame, one picture.

The joined frame is solved as the sum of its N frames: a sum has the gain of the sensor, so that one planned solver
serves any N. Its read noise is taken as that of one frame: the missing factor sqrt(N) is small beside shot noise. The
picture and its report are in DN of one exposure, that of the reference (`in_one_exposure`, NUMERICS.md 9.2).
"""

from collections import deque
from collections.abc import Container, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np

from device.clock import Deadline
from device.errors import FrameError, SettingError
from device.recon.assessment.quality_figures import is_banded
from device.recon.burst import BurstJoiner, JoinedFrame, SeenFrame, require_light
from device.recon.corrections import is_steadier, with_corrections
from device.recon.durations import LEAST_RUNS, DurationEstimate
from device.recon.estimation.refraction.task import RefractionTask
from device.recon.frame_run import EyePsf
from device.recon.frames import checked, noise_frame
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.stage import QuickLook, RoundDone, Step
from device.values import FrameUse, Reconstruction

NO_TIME = "the time budget left no time to join it"
NOT_SOLVED = "the time budget left no time to solve the joined frames"


@dataclass(frozen=True)
class PreparedFrame:
    """A frame of a burst before the other ones are known.

    Attributes
    ----------
    look
        Quick look of the frame.
    seen
        What is needed to join it; None for a frame without others.
    refraction
        Task that estimates its refraction, if it has begun.
    """

    look: QuickLook
    seen: SeenFrame | None
    refraction: RefractionTask | None = None


class BurstReconstructor:
    """Reconstruction of bursts: their frames are registered, joined and solved as one.

    One burst at a time. Between two of its steps `single` may make quick looks of other frames, and `prepare` may be
    called. Not thread-safe.

    Parameters
    ----------
    single
        Reconstructor of the joined frame, of quick looks and of pictures of one frame, with two stages at least.
    planner
        Planner of the FFTs.
    timed
        True: measure the costs of the steps on noise, for deadlines.

    Raises
    ------
    SettingError
        `single` has one stage, which is that of the first frame: the joined frame would not be solved.
    """

    def __init__(self, single: Reconstructor, planner: Planner, *, timed: bool = True) -> None:
        if len(single.stages) < 2:
            raise SettingError("a burst needs a quick look before its picture", "Give two recipes, or none.")
        calibration = single.calibration
        shape = single.shape
        index = single.psf_index
        self.single = single
        self.clock = single.clock
        self.joiner = BurstJoiner(calibration, shape, planner, single.clock, index, single)
        self.see_cost = DurationEstimate(single.stages[0].pace)  # of one frame
        self.join_cost = DurationEstimate(single.stages[0].pace)
        if timed:
            self._warm_up()

    def _warm_up(self) -> None:
        """Join two frames of noise, to compile the kernels and to measure the cost."""
        noise = noise_frame(self.single.calibration, self.single.shape)
        pace = self.single.stages[0].pace
        for k in range(1 + LEAST_RUNS):
            if k == 1:  # the first one compiles
                self.see_cost = DurationEstimate(pace)
                self.join_cost = DurationEstimate(pace)
            run = _Run(self, None)
            for step in run.join([noise, noise], np.zeros_like(noise)):
                assert isinstance(step, RoundDone)

    def prepare(
        self,
        counts: Pixels,
        dark: Pixels | None = None,
        *,
        refract: bool = False,
        cylinder: bool = True,
        alone: bool = False,
    ) -> PreparedFrame:
        """Return a frame with its quick look, ready for `steps`, while the next frames are exposed.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        refract
            True: a thread begins to estimate its refraction. A burst needs it of its first used frame only.
        cylinder
            True: with the cylinder.
        alone
            True: there is no other frame to be joined with.

        Returns
        -------
        PreparedFrame
            Quick look, and what is needed to join the frame.

        Raises
        ------
        FrameError
            The frame has no light, too many missing pixels, or rows that are repeated or missing.
        """
        look = self.single.quick_look(counts, dark)
        counts = look.even.counts
        require_light(look)
        seen = None if alone else self.joiner.see(counts, dark, look)
        task = None
        if refract:
            task = self.single.begin_refraction(counts, dark, look.defects[0], with_cylinder=cylinder)
        return PreparedFrame(look, seen, task)

    def steps(
        self,
        frames: Sequence[Pixels],
        dark: Pixels | None = None,
        *,
        simulated: bool,
        deadline: Deadline | None = None,
        unusable: Mapping[int, str] | None = None,
        prepared: Mapping[int, PreparedFrame] | None = None,
        eye_psf: EyePsf = EyePsf.ESTIMATED,
        joined: JoinedFrame | None = None,
    ) -> Iterator[Step]:
        """Yield the quick look of the first usable frame, RoundDone after frames and rounds, and the burst's picture.

        Each frame that is not prepared and each round is followed by RoundDone. The deadline moves by the time until
        the consumer continues after it. A burst of one usable frame gives the picture of that frame. A deadline that
        leaves no time to join all frames, and to solve the joined one in some rounds, joins fewer, or uses the first.

        Parameters
        ----------
        frames
            Counts of each frame, uint16 or float32 (rows, cols).
        dark
            Dark frame of all of them; None: that of the calibration.
        simulated
            Mark that is copied to the result.
        deadline
            Time by which the picture is needed; None: all rounds.
        unusable
            Reason of each frame that must not enter the picture, by its index, never the first.
        prepared
            Frames that are prepared with this dark frame, by index.
        eye_psf
            PSF of the picture.
        joined
            The frames, if they are joined already.

        Yields
        ------
        StageResult, RoundDone or Reconstruction
            The last one is the picture, linear float32 (rows, cols) of the sensor.

        Raises
        ------
        FrameError
            A frame before the first usable one has another shape, or no frame can be used.
        """
        run = _Run(self, deadline, eye_psf, joined)
        ready = dict(prepared or {})
        tasks = {k: prepared_frame.refraction for k, prepared_frame in ready.items()}
        looks = {k: prepared_frame.look for k, prepared_frame in ready.items()}
        if len(frames) == 1:
            yield from self.single.steps(
                frames[0],
                dark,
                simulated=simulated,
                deadline=deadline,
                eye_psf=eye_psf,
                refraction=tasks.get(0),
                look=looks.get(0),
            )
            return
        first, known_bad = self._first_look(frames, dark, dict(unusable or {}), looks)
        yield looks[first].stage
        unusable = known_bad if joined else self._within_time(run, frames, ready, known_bad)
        if NO_TIME in unusable.values() and len(unusable) == len(frames) - 1:
            self.see_cost.skipped(usually_fits=False)  # a trial that takes too long would cost the picture its rounds
            self.join_cost.skipped(usually_fits=False)
            uses: Sequence[FrameUse] = [FrameUse(k, False, None, 0.0, unusable.get(k)) for k in range(len(frames))]
            yield from run.solve_one(frames[first], dark, uses, first, simulated, tasks.get(first), looks[first])
            return
        made = yield from self._solve(run, frames, dark, unusable, ready, looks, simulated)
        quality = made.report.quality
        cost_s = self._cost_s(frames, (), unusable) + sum(made.report.seconds.values())
        if (is_banded(quality) or "flicker" in quality) and run.fits(cost_s):
            steady, flicker = self._without_flicker(frames, dark, unusable)
            if flicker is not None:
                looks = {first: self.single.quick_look(steady[first], dark)}
                run = _Run(self, run.deadline, eye_psf)
                again = yield from self._solve(run, steady, dark, unusable, {}, looks, simulated)
                is_better = is_steadier(made, again)
                used, other = (again, made) if is_better else (made, again)
                found = {"flicker": flicker} if is_better else {}
                made = with_corrections(used, found, (), sum(other.report.seconds.values()))
        yield made

    def _first_look(
        self, frames: Sequence[Pixels], dark: Pixels | None, unusable: dict[int, str], looks: dict[int, QuickLook]
    ) -> tuple[int, dict[int, str]]:
        """Add the quick look of the first frame that has one to `looks`; return its index, and all unusable frames."""
        for k, frame in enumerate(frames):
            checked(frame, self.single.shape)
            try:
                if k not in looks and k not in unusable:
                    looks[k] = self.single.quick_look(frame, dark)
            except FrameError as error:
                unusable[k] = error.message
                if k == len(frames) - 1:
                    raise
            if k in looks:
                return k, unusable
        raise FrameError("no frame of the burst can be used", "Take the burst again.")

    def _within_time(
        self, run: "_Run", frames: Sequence[Pixels], ready: Container[int], unusable: Mapping[int, str]
    ) -> dict[int, str]:
        """Return the reasons of the unusable frames, with the last ones that the deadline leaves no time to join.

        Rounds on fewer frames are worth more than a joined frame that is not solved.
        """
        reasons = dict(unusable)
        usable = [k for k in range(len(frames)) if k not in reasons]
        solving_s = self.single.stages[-1].reserved_s
        while len(usable) > 1 and not run.fits(self._cost_s(frames, ready, reasons) + solving_s):
            reasons[usable.pop()] = NO_TIME
        return reasons

    def _without_flicker(
        self, frames: Sequence[Pixels], dark: Pixels | None, unusable: Mapping[int, str]
    ) -> tuple[list[Pixels], float | None]:
        """Return the frames without their flicker, as far as they show any, and the largest one; None without any."""
        steady, flickers = list(frames), []
        for k, frame in enumerate(frames):
            usable = k not in unusable and frame.shape == self.single.shape
            found = self.single.corrections.flicker(frame, dark) if usable else None
            if found is not None:
                steady[k] = found.counts
                flickers.append(found.flicker)
        return steady, max(flickers, default=None)

    def _solve(
        self,
        run: "_Run",
        frames: Sequence[Pixels],
        dark: Pixels | None,
        unusable: Mapping[int, str] | None,
        ready: Mapping[int, PreparedFrame],
        looks: Mapping[int, QuickLook],
        simulated: bool,
    ) -> Generator[Step, None, Reconstruction]:
        """Join the frames, unless the run has them joined; yield the steps before their picture, and return it.

        `looks` has that of the first frame; other arguments as for `steps`.
        """
        if run.joined is None:
            yield from run.join(frames, dark, unusable, _seen(ready))
        assert run.joined is not None
        uses = run.joined.frames
        used = [use.index for use in uses if use.used]
        task = ready[used[0]].refraction if used[0] in ready else None
        known = task, looks.get(used[0])
        if len(used) == 1:
            steps = run.solve_one(frames[used[0]], dark, uses, used[0], simulated, *known)
        else:
            steps = run.solve_joined([frames[k] for k in used], dark, simulated, *known)
        for step in steps:
            if isinstance(step, Reconstruction):
                return step
            yield step
        raise AssertionError("a reconstruction ends with a picture")

    def join(
        self,
        frames: Sequence[Pixels],
        dark: Pixels | None,
        unusable: Mapping[int, str],
        prepared: Mapping[int, PreparedFrame],
    ) -> JoinedFrame:
        """Return the joined frame, for `steps` of the same frames.

        Parameters
        ----------
        frames
            Counts of each frame, uint16 or float32 (rows, cols).
        dark
            Dark frame of all of them; None: that of the calibration.
        unusable
            Reason of each frame that must not enter the picture, by its index.
        prepared
            Frames that are prepared with this dark frame, by index.

        Returns
        -------
        JoinedFrame
            The frame that `steps` solves.

        Raises
        ------
        FrameError
            No frame can be used.
        """
        run = _Run(self, None)
        deque(run.join(frames, dark, unusable, _seen(prepared)), maxlen=0)
        assert run.joined is not None
        return run.joined

    def _cost_s(self, frames: Sequence[Pixels], ready: Container[int], unusable: Mapping[int, str] | None) -> float:
        """Return the estimated duration of joining the frames, in seconds; those that are `ready` cost less."""
        usable = [k for k in range(len(frames)) if k not in (unusable or {})]
        unseen = sum(k not in ready for k in usable)
        return self.see_cost.seconds_of(unseen) + self.join_cost.seconds_of(len(usable))


def _seen(prepared: Mapping[int, PreparedFrame]) -> dict[int, SeenFrame]:
    return {k: frame.seen for k, frame in prepared.items() if frame.seen is not None}


class _Run:
    """State of the reconstruction of one burst: its deadline, the duration of joining, and the joined frame."""

    def __init__(
        self,
        owner: "BurstReconstructor",
        deadline: Deadline | None,
        eye_psf: EyePsf = EyePsf.ESTIMATED,
        joined: JoinedFrame | None = None,
    ) -> None:
        self._owner, self.deadline, self._eye_psf = owner, deadline, eye_psf
        self.joined = joined
        self._join_s = 0.0

    def fits(self, cost_s: float) -> bool:
        """Return True if a step of `cost_s` seconds fits into the time left, or if there is no deadline."""
        return self.deadline is None or self.deadline.fits(cost_s)

    def join(
        self,
        frames: Sequence[Pixels],
        dark: Pixels | None,
        unusable: Mapping[int, str] | None = None,
        ready: Mapping[int, SeenFrame] | None = None,
    ) -> Iterator[RoundDone]:
        """Join the frames; yield RoundDone after each that is not ready. The deadline moves by the consumer's time."""
        owner = self._owner
        begin_s = owner.clock.now_s()
        for step in owner.joiner.steps(frames, unusable, dark, ready):
            paused_s = owner.clock.now_s()
            self._join_s += paused_s - begin_s
            if isinstance(step, JoinedFrame):
                owner.join_cost.add((paused_s - begin_s) / len(step.frames))
                self.joined = step
                break
            owner.see_cost.add(paused_s - begin_s)
            yield step
            begin_s = owner.clock.now_s()
            self.deadline = None if self.deadline is None else self.deadline.later(begin_s - paused_s)

    def solve_joined(
        self,
        used: Sequence[Pixels],
        dark: Pixels | None,
        simulated: bool,
        refraction: RefractionTask | None,
        look: QuickLook | None,
    ) -> Iterator[Step]:
        """Yield the steps of the picture of the joined frames `used`; `refraction` and `look` are the first one's."""
        owner = self._owner
        joined = self.joined
        assert joined is not None
        total = joined.counts * np.float32(joined.light)
        is_solved = False
        for step in owner.single.steps(
            used[0],
            dark,
            simulated=simulated,
            deadline=self.deadline,
            joined=total,
            eye_psf=self._eye_psf,
            refraction=refraction,
            others=used[1:],
            look=look,
        ):
            if isinstance(step, RoundDone):
                yield step
            elif isinstance(step, Reconstruction) and is_solved:
                yield self._reported(in_one_exposure(step, joined.light), joined.frames)
            elif isinstance(step, Reconstruction):  # no time for the last stage: this is the picture of one frame
                index = next(use.index for use in joined.frames if use.used)
                yield self._reported(step, only(index, joined.frames, NOT_SOLVED))
            elif step.last:  # the quick look was that of the first frame
                is_solved = True
                yield replace(step, picture=step.picture / np.float32(joined.light))

    def solve_one(
        self,
        counts: Pixels,
        dark: Pixels | None,
        uses: Sequence[FrameUse],
        index: int,
        simulated: bool,
        refraction: RefractionTask | None,
        look: QuickLook | None,
    ) -> Iterator[Step]:
        """Yield the steps of the picture of one frame, the one with this index; `uses` says why no other is used.

        `refraction`: its task, if it has begun; `look`: its quick look, if there is one.
        """
        for step in self._owner.single.steps(
            counts,
            dark,
            simulated=simulated,
            deadline=self.deadline,
            eye_psf=self._eye_psf,
            refraction=refraction,
            look=look,
        ):
            if isinstance(step, Reconstruction):
                yield self._reported(step, only(index, uses))
            elif isinstance(step, RoundDone) or step.last:
                yield step

    def _reported(self, made: Reconstruction, frames: tuple[FrameUse, ...]) -> Reconstruction:
        seconds = {"join": self._join_s} | made.report.seconds
        return replace(made, report=replace(made.report, seconds=seconds, frames=frames))


def in_one_exposure(made: Reconstruction, light: float) -> Reconstruction:
    """Return the picture of a sum of frames, and its report, in DN of one exposure.

    The sum has `light` times the light of one exposure; in DN of one exposure the noise is that of the average. Weights
    of the solver (tau, mu) stay those of the sum.
    """
    report = made.report
    quality = report.quality | {"mean_dn": report.quality["mean_dn"] / light}
    figures = {name: value / light if name.endswith("_dn") else value for name, value in report.regularisation.items()}
    if "prior_log_power" in figures:
        figures["prior_log_power"] -= 2 * log(light)
    noise_dn = None if report.noise_dn is None else report.noise_dn / light
    report = replace(report, quality=quality, regularisation=figures, noise_dn=noise_dn)
    return replace(made, picture=made.picture / np.float32(light), report=report)


def only(index: int, uses: Sequence[FrameUse], reason: str = NO_TIME) -> tuple[FrameUse, ...]:
    """Return the uses of the frames of a burst for a picture of frame `index` alone.

    `uses` are those known so far; each other frame keeps its reason, or has this `reason`.
    """
    return tuple(
        FrameUse(use.index, True, (0.0, 0.0), 1.0)
        if use.index == index
        else replace(use, used=False, weight=0.0, reason=use.reason or reason)
        for use in uses
    )
