"""State of the reconstruction of one frame: its stages within the deadline, and what was found on the way."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from device.clock import Clock, Deadline
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.refraction.estimator import NoRefraction, Refraction
from device.recon.estimation.refraction.task import RefractionTask
from device.recon.frames import plane
from device.recon.model.kernels import Pixels, Places
from device.recon.solvers.solver import Diagnostics
from device.recon.stage import ROUND_DONE, QuickLook, RoundDone, Solved, Stage
from device.values import Image

ChannelFrame = tuple[Pixels, Pixels | None, Places | None]  # counts, dark frame, defective pixels


class EyePsf(Enum):
    """PSF with which the later stages of a frame are solved."""

    ESTIMATED = "of the refraction that is estimated from the frame"
    KEPT = "that of the picture before"
    STORED = "that of the calibration"


@dataclass(frozen=True)
class Asked:
    """What `Reconstructor.steps` was asked for: its arguments that are the same for a corrected frame.

    `white` is False for a frame whose noise a correction has coloured: its spectrum says nothing about the PSF.
    """

    dark: Pixels | None
    simulated: bool
    rounds: int | None
    quick: bool
    eye_psf: EyePsf
    white: bool = True


@dataclass(frozen=True)
class Known:
    """What is known of a frame before it is solved."""

    refraction: RefractionTask | None = None
    others: Sequence[Pixels] = ()
    look: QuickLook | None = None


NOTHING = Known()


class FrameRun:
    """State of the reconstruction of one frame.

    Parameters
    ----------
    first
        First stage of the reconstructor.
    defects
        Finder of the defective pixels.
    clock
        Clock of the deadline.
    asked
        What was asked for.
    counts
        Counts, uint16 or float32, (rows, cols) or (rows, cols, 3).
    joined
        Linear frame that the later stages solve instead (`Reconstructor.steps`).
    deadline
        Time by which the picture is needed; None: all rounds.
    """

    def __init__(
        self,
        first: Stage,
        defects: DefectFinder,
        clock: Clock,
        asked: Asked,
        counts: Pixels,
        joined: Image | None = None,
        deadline: Deadline | None = None,
    ) -> None:
        self._first = first
        self._defects = defects
        self.clock = clock
        self.asked = asked
        self.counts = counts
        self.joined = joined
        self.deadline = deadline
        self.found: dict[int, Places | None] = {}
        self.done: Stage = first
        self.solved: Solved | None = None  # None before the first stage
        self.rounds_done = 0
        self.stopped = "done"
        self.refraction: Refraction | NoRefraction | None = None
        self.refraction_s = self.cylinder_s = self.between_s = 0.0

    def again(self, counts: Pixels, joined: Image | None = None, white: bool = True) -> "FrameRun":
        """Return the run of a corrected frame, to the same deadline; `white`: its noise has kept its spectrum."""
        asked = replace(self.asked, white=self.asked.white and white)
        return FrameRun(self._first, self._defects, self.clock, asked, counts, joined, self.deadline)

    @property
    def channels(self) -> int:
        """Number of channels of the frame."""
        return 1 if self.counts.ndim == 2 else self.counts.shape[2]

    def fits(self, cost_s: float) -> bool:
        """Return True if a step of `cost_s` seconds fits into the time left, or if there is no deadline."""
        return self.deadline is None or self.deadline.fits(cost_s)

    def cost_s(self, stage: Stage, reserved: bool = False) -> float:
        """Return the minimum duration of a stage for all channels in seconds: start, one round and finish.

        With `reserved` with all rounds that are kept free before the refraction begins.
        """
        channel_s = stage.reserved_s if reserved else stage.least_s
        return self.channels * channel_s - (self.channels - 1) * stage.finish_cost.seconds

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
        dark = None if self.asked.dark is None else plane(self.asked.dark, c)
        if c not in self.found:
            self.found[c] = self._defects(counts, dark)
        return counts, dark, self.found[c]

    @property
    def known_defects(self) -> Places | None:
        """Flat indices of the pixels that are defective in at least one solved channel; None if there are none."""
        found = [places for places in self.found.values() if places is not None]
        return np.unique(np.concatenate(found)) if found else None

    def begin_with(self, stage: Stage, look: QuickLook) -> None:
        """Take over the first stage of this frame, solved before."""
        stage.planes = look.planes.copy()
        self.found = dict(look.defects)
        self.done = stage
        self.solved = look.solved

    def has_time_for(self, stage: Stage) -> bool:
        """Return whether a stage runs: the first one always, a later one if there is time; else record the reason."""
        if self.deadline is not None and self.solved is not None and not self.fits(self.cost_s(stage)):
            self.stopped = "deadline"
            stage.skipped(self.deadline.left_s() / self.channels)
            return False
        return True

    def solve(self, stage: Stage, pauses: bool) -> Iterator[RoundDone]:
        """Solve one stage, channel by channel; with `pauses` yield ROUND_DONE after each round."""
        joined = None if stage is self._first else self.joined
        if len(stage.planes) != self.channels:
            stage.planes = np.zeros((self.channels, *stage.grid.shape), np.float32)
        for c in range(self.channels):
            yield from self._channel(stage, c, pauses, joined)
        self.done = stage

    def _channel(self, stage: Stage, c: int, pauses: bool, joined: Image | None) -> Iterator[RoundDone]:
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
        if stage is self._first:
            stage.pace.add(now_s - begin_s)
        stage.start_cost.add(now_s - begin_s)
        self.stopped = "done"
        most = stage.most if self.asked.rounds is None else min(self.asked.rounds, stage.most)
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

    def _fits_another(self, stage: Stage, channels_left: int) -> bool:
        """Return True if one more round fits, with time for the remaining channels (as many rounds) and the finish."""
        if self.deadline is None:
            return True
        rounds_s = (self.rounds_done + 1) * stage.round_cost.seconds
        others_s = (channels_left - 1) * (stage.start_cost.seconds + rounds_s + stage.end_cost.seconds)
        ends_s = stage.end_cost.seconds + stage.finish_cost.seconds
        return self.deadline.fits(stage.round_cost.seconds + others_s + ends_s)
