"""Reconstruction of the bursts of an instrument: quick look of the first frame, joined frame, one picture.

The joined frame is solved as the sum of its frames: a sum has the gain of the sensor, so that nothing is planned for
the number of frames. Its read noise, sqrt(N) times that of one frame, is small beside the shot noise of the sum.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from device.clock import Deadline
from device.recon.burst import BurstJoiner, JoinedFrame
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import DurationEstimate, Reconstructor, RoundDone, Step
from device.values import FrameUse, Reconstruction

NO_TIME = "the time budget left no time to join the burst"


class BurstReconstructor:
    """Reconstruction of bursts by `single`, which also makes quick looks and pictures of one frame.

    One burst at a time; between two of its steps `single` may make quick looks of other frames. Not thread-safe.
    """

    def __init__(self, single: Reconstructor, planner: Planner) -> None:
        calibration, shape, index = single.calibration, single.shape, single.psf_index
        self.single, self.clock = single, single.clock
        self.joiner = BurstJoiner(calibration, shape, planner, single.clock, index, single)
        self.join_cost = DurationEstimate()  # of one frame
        self._warm_up()

    def _warm_up(self) -> None:
        """Make a picture of two frames of noise, to compile the kernels and to measure the cost."""
        noise = np.random.default_rng(0).integers(100, 200, self.single.shape, dtype=np.uint16)
        for _ in range(2):  # the first one compiles
            self.join_cost = DurationEstimate()
            run = _Run(self, None)
            for step in run.join([noise, noise], np.zeros_like(noise)):
                assert isinstance(step, RoundDone)

    def steps(
        self, frames: Sequence[Pixels], dark: Pixels | None = None, *, simulated: bool,
        deadline: Deadline | None = None, unusable: Mapping[int, str] | None = None,
    ) -> Iterator[Step]:  # fmt: skip
        """Yield the quick look of the first frame, a pause after each frame and round, and the picture of the burst.

        `frames` are uint16 or float32 (rows, cols), all with the dark frame `dark`; `unusable` holds the reason of each
        frame that must not enter the picture, by its index, never the first. The deadline moves by the time of
        the pauses. A burst of one usable frame gives the picture of that frame; so does a deadline that leaves no time
        to join them. FrameError for another shape, or if no frame can be used.
        """
        if len(frames) == 1:
            yield from self.single.steps(frames[0], dark, simulated=simulated, deadline=deadline)
            return
        run, first = _Run(self, deadline), None
        for step in self.single.steps(frames[0], dark, simulated=simulated, quick=True):
            if isinstance(step, Reconstruction):
                first = step
            else:
                yield step
        assert first is not None
        if not run.fits(len(frames) * self.join_cost.seconds):
            self.join_cost.halve_maximum()
            uses: Sequence[FrameUse] = [FrameUse(k, False, None, 0.0) for k in range(len(frames))]
            yield from run.solve_one(frames[0], dark, uses, 0, simulated)
            return
        yield from run.join(frames, dark, unusable)
        assert run.joined is not None
        uses = run.joined.frames
        used = [one.index for one in uses if one.used]
        if len(used) == 1:
            yield from run.solve_one(frames[used[0]], dark, uses, used[0], simulated)
        else:
            yield from run.solve_joined(frames[used[0]], dark, first, simulated)


class _Run:
    """State of the reconstruction of one burst: its deadline, the duration of joining, and the joined frame."""

    def __init__(self, owner: "BurstReconstructor", deadline: Deadline | None) -> None:
        self._owner, self._deadline = owner, deadline
        self.joined: JoinedFrame | None = None
        self._join_s = 0.0

    def fits(self, cost_s: float) -> bool:
        """Return True if a step of `cost_s` seconds fits into the time left, or if there is no deadline."""
        return self._deadline is None or self._deadline.fits(cost_s)

    def join(
        self, frames: Sequence[Pixels], dark: Pixels | None, unusable: Mapping[int, str] | None = None
    ) -> Iterator[RoundDone]:
        """Join the frames; yield a pause after each of them, by which the deadline moves."""
        owner = self._owner
        begin_s = owner.clock.now_s()
        for step in owner.joiner.steps(frames, unusable, dark):
            paused_s = owner.clock.now_s()
            self._join_s += paused_s - begin_s
            if isinstance(step, JoinedFrame):
                self.joined = step
                break
            yield step
            begin_s = owner.clock.now_s()
            self._deadline = None if self._deadline is None else self._deadline.later(begin_s - paused_s)
        owner.join_cost.add(self._join_s / len(frames))

    def solve_joined(
        self, counts: Pixels, dark: Pixels | None, first: Reconstruction, simulated: bool
    ) -> Iterator[Step]:
        """Yield the steps of the picture of the joined frame; `counts` and `first`: first frame and its quick look."""
        owner, joined = self._owner, self.joined
        assert joined is not None
        total, is_solved = joined.counts * np.float32(joined.light), False
        for step in owner.single.steps(counts, dark, simulated=simulated, deadline=self._deadline, joined=total):
            if isinstance(step, RoundDone):
                yield step
            elif isinstance(step, Reconstruction) and is_solved:
                quality = step.report.quality | {"saturated": first.report.quality["saturated"]}
                yield self._reported(replace(step, report=replace(step.report, quality=quality)), joined.frames)
            elif isinstance(step, Reconstruction):  # no time for the last stage: this is the picture of one frame
                yield self._reported(step, only(next(one.index for one in joined.frames if one.used), joined.frames))
            elif step.last:  # the quick look was that of the first frame
                is_solved = True
                yield step

    def solve_one(
        self, counts: Pixels, dark: Pixels | None, uses: Sequence[FrameUse], index: int, simulated: bool
    ) -> Iterator[Step]:
        """Yield the steps of the picture of one frame, the one with this index; `uses` says why no other is used."""
        for step in self._owner.single.steps(counts, dark, simulated=simulated, deadline=self._deadline):
            if isinstance(step, Reconstruction):
                yield self._reported(step, only(index, uses))
            elif isinstance(step, RoundDone) or step.last:
                yield step

    def _reported(self, made: Reconstruction, frames: tuple[FrameUse, ...]) -> Reconstruction:
        seconds = {"join": self._join_s} | made.report.seconds
        return replace(made, report=replace(made.report, seconds=seconds, frames=frames))


def only(index: int, uses: Sequence[FrameUse]) -> tuple[FrameUse, ...]:
    """Return the use of the frames of a picture of one of them; a frame without another reason is left for the time."""
    return tuple(
        FrameUse(one.index, True, (0.0, 0.0), 1.0)
        if one.index == index
        else replace(one, used=False, weight=0.0, reason=one.reason or NO_TIME)
        for one in uses
    )
