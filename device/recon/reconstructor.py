"""From counts to a picture: a quick look at once, then rounds that make it better, none begun that cannot finish."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite, isinf
from typing import Any

import numpy as np

from device.clock import Clock, Deadline
from device.errors import FrameError, SettingError
from device.recon.defects import DefectFinder
from device.recon.kernels import Pixels, Places
from device.recon.methods import DEFAULT, Solver, method_named
from device.recon.model import field_radius_px
from device.recon.plan import Planner, Spectrum
from device.recon.prepare import Preparer
from device.recon.psf_consistency import Match, PsfConsistency
from device.recon.quality import PRESUMED, complaints, explains, is_lit, is_measured, matched
from device.recon.refraction import Refraction, Refractor, can_refract
from device.recon.resolution import EMPTY, EMPTY_OPEN, working_bin
from device.recon.upsample import to_sensor
from device.values import Calibration, Image, Reconstruction, Report, check_image_shape


@dataclass(frozen=True)
class Recipe:
    """One rung of the ladder: a method and how many sensor pixels make one sample, n x n; at most `rounds` rounds."""

    method: str = DEFAULT
    bin: int = 1
    rounds: int | None = None


@dataclass(frozen=True)
class Stage:
    """A picture on the way: the recipe that made it, and the part that people look at, linear, on its own samples."""

    recipe: Recipe
    picture: Image
    last: bool


ChannelFrame = tuple[Pixels, Pixels | None, Places | None]  # counts, dark frame, defective pixels
Watcher = Callable[[Stage], None]
Between = Callable[[], None]


def ladder(calibration: Calibration, shape: tuple[int, int], index: int = 0) -> tuple[Recipe, Recipe]:
    """What the instrument climbs by itself: a quick look, then the best picture at the resolution the optics gives.

    Where no field is known the object may be anywhere: then the solver is the one that doubts its model.
    """
    is_open = isinf(field_radius_px(calibration))
    n = working_bin(calibration.psfs[index], EMPTY_OPEN if is_open else EMPTY)
    while n > 1 and min(shape) // n < 64:
        n -= 1
    coarse = 2 * n if min(shape) // (2 * n) >= 16 else n
    if is_open:
        return Recipe("gradient", coarse), Recipe("open", n)
    return Recipe("evidence", coarse), Recipe("variation", n)


class Cost:
    """What something took lately, and so may take again: the worst of its last runs; the slowest press counts."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=12)

    def add(self, seconds: float) -> None:
        """Remember one run."""
        self._seen.append(seconds)

    @property
    def seconds(self) -> float:
        """The worst of the last dozen; nothing is known to be free."""
        return max(self._seen, default=0.0)

    def doubt(self) -> None:
        """Believe the worst run only half: what one bad moment made refused must get its chance again."""
        if self._seen:
            self._seen[self._seen.index(self.seconds)] /= 2


class _Rung:
    """Everything that one recipe needs, planned: its preparer, its solver, its output, its cost."""

    def __init__(self, recipe: Recipe, calibration: Calibration, shape: tuple[int, int], planner: Planner, index: int):
        method = method_named(recipe.method)
        self.recipe = recipe
        self.model = method.model(calibration, shape, recipe.bin, planner, index)
        self.grid = self.model.grid
        self.scale = 1.0
        self.solver: Solver = method.build(self.model, calibration, planner)
        self.preparer = Preparer(calibration, self.grid, self.solver.inbox)
        self.most = self.solver.rounds if recipe.rounds is None else recipe.rounds
        self.planes: Image = np.zeros((1, *self.grid.shape), np.float32)
        self.start_cost, self.round_cost, self.finish_cost = Cost(), Cost(), Cost()

    def refocus(self, otf: Spectrum, scale: float) -> None:
        """See from now on through the OTF of the PSF stretched by `scale`."""
        self.scale = scale
        if otf is not self.model.otf:
            self.model.refocus(otf)
            self.solver.refocus()

    @property
    def picture(self) -> Image:
        """What was solved last: (rows, cols) or (rows, cols, 3) of the grid."""
        return self.planes[0] if len(self.planes) == 1 else np.moveaxis(self.planes, 0, -1)

    def doubt(self) -> None:
        """It was refused: let its costs age, so that one bad moment does not refuse it for ever."""
        for cost in (self.start_cost, self.round_cost, self.finish_cost):
            cost.doubt()

    @property
    def shown(self) -> Image:
        """The part of it that people look at."""
        return self.picture[self.grid.shown]


class Reconstructor:
    """Plans once for a calibration and a sensor shape; then turns frames into pictures within a deadline.

    `recipes` run in order; the last is the wanted picture, those before it are quick looks. One thread at a time.
    `timed` measures on noise what every step costs, before the first deadline; without deadlines leave it.
    `consistency` is asked about each frame's PSF, outside the deadline: for files, where seconds do not matter.
    With `refract`, where geometry and field are known, the frame tells the eye's refraction after the quick look, and
    what follows is solved with the PSF of that eye.
    """

    def __init__(
        self, calibration: Calibration, shape: tuple[int, int], planner: Planner, clock: Clock,
        recipes: tuple[Recipe, ...] = (), psf_index: int = 0, refract: bool = True,
        consistency: PsfConsistency | None = None, timed: bool = True,
    ) -> None:  # fmt: skip
        recipes = recipes or ladder(calibration, shape, psf_index)
        if min(recipe.bin for recipe in recipes) < 1:
            raise SettingError("a sample is made of at least one pixel")
        self.calibration, self.shape, self.clock, self.psf_index = calibration, shape, clock, psf_index
        self.rungs = [_Rung(recipe, calibration, shape, planner, psf_index) for recipe in recipes]
        self.defects = DefectFinder(calibration, shape, psf_index)
        self.refractor = None
        if refract and can_refract(calibration):
            self.refractor = Refractor(calibration, shape, planner, psf_index)
        self._sharp = self.rungs[min(1, len(self.rungs) - 1) :]  # what is solved with the eye's own PSF
        self._find_cost, self._refocus_cost = Cost(), Cost()
        self._consistency: PsfConsistency | None = None
        self._warm_up(timed)
        self._consistency = consistency  # noise needs no check

    def _warm_up(self, timed: bool) -> None:
        """Run on noise, so that the first frame meets compiled code and touched memory and, `timed`, a known cost."""
        noise = np.random.default_rng(0).integers(100, 200, self.shape, dtype=np.uint16)
        self(noise, rounds=1)  # compiles, where no compiled code is kept
        if not timed:
            return
        self(noise, np.zeros_like(noise), quick=True)  # with a dark frame it is other code
        for rung in self.rungs:
            rung.start_cost, rung.round_cost, rung.finish_cost = Cost(), Cost(), Cost()
        self._find_cost = Cost()
        self(noise, rounds=2)
        for m_dpt in (1.0, None):
            self._refocus(m_dpt)

    def __call__(
        self, counts: Pixels, dark: Pixels | None = None, *, simulated: bool = False,
        deadline: Deadline | None = None, watch: Watcher | None = None, rounds: int | None = None, quick: bool = False,
        between: Between | None = None,
    ) -> Reconstruction:  # fmt: skip
        """The best picture that fits: linear float32, rows x cols (x 3) of the sensor.

        `counts` and `dark` are uint16 or float32 (rows, cols) or (rows, cols, 3). The first rung always runs;
        with `quick` nothing else does. `between` is called between two rounds of the last rung; the time that it takes
        is given back, and it may take a quick look at another frame with this same reconstructor.
        """
        self._refuse_other_shapes(counts)
        climb = _Climb(self, counts, dark, deadline, rounds, between if len(self.rungs) > 1 else None)
        begin_s = self.clock.now_s()
        for rung in self.rungs[:1] if quick else self.rungs:
            if rung is self._sharp[0] and not quick:
                self._focus(climb)
            if not climb.up(rung):
                break
            if watch is not None:
                watch(Stage(rung.recipe, rung.shown, last=rung is self.rungs[-1]))
        solved_s = self.clock.now_s()
        picture = to_sensor(climb.done.picture, climb.done.grid)
        finished_s = self.clock.now_s()
        climb.done.finish_cost.add(finished_s - solved_s)
        solve_s = solved_s - begin_s - climb.focus_s - climb.away_s
        seconds = {"solve": solve_s, "refract": climb.focus_s, "upsample": finished_s - solved_s}
        return Reconstruction(picture, self._report(climb, seconds), simulated)

    def _focus(self, climb: "_Climb") -> None:
        """Ask the frame for the eye's refraction if time allows, and see through the PSF of that eye."""
        begin_s = self.clock.now_s()
        if self.refractor is None:
            return
        if climb.fits(self._find_cost.seconds + self._refocus_cost.seconds + climb.cost_s(self._sharp[0])):
            climb.refraction = self.refractor.find(*climb.brightest())
            self._find_cost.add(self.clock.now_s() - begin_s)
        self._refocus(climb.sharp_dpt)
        climb.focus_s = self.clock.now_s() - begin_s

    def _refocus(self, m_dpt: float | None) -> None:
        """The PSF of an eye with mean sphere M from now on; None: the stored one."""
        if self.refractor is None:
            return
        begin_s = self.clock.now_s()
        for rung in self._sharp:
            if m_dpt is None:
                rung.refocus(rung.model.stored, 1.0)
            else:
                rung.refocus(self.refractor.otf(rung.grid, m_dpt), self.refractor.scale(m_dpt))
        if m_dpt is not None:
            self._refocus_cost.add(self.clock.now_s() - begin_s)

    def _refuse_other_shapes(self, counts: Pixels) -> None:
        check_image_shape(counts.shape)
        if counts.shape[:2] != self.shape:
            raise FrameError(
                f"the frame has {counts.shape[:2]} pixels, the calibration {self.shape}", "Use the head's own PSF."
            )

    def _report(self, climb: "_Climb", seconds: dict[str, float]) -> Report:
        recipe, facts = climb.done.recipe, climb.facts
        dark = not facts["mean_dn"] > 0 or facts["noise_dn"] == 0
        quality = {key: facts[key] for key in ("saturated", "missing", "mean_dn")} | facts.get("quality", {})
        misfit = facts.get("residual") if isfinite(field_radius_px(self.calibration)) else None
        match, eye = matched(quality), climb.refraction
        if self._consistency is not None and not dark:
            figures = self._consistency(climb.counts, climb.psf_scale, climb.known_defects)
            quality |= {} if figures is None else figures.facts
            match = Match.UNKNOWN if figures is None else figures.match
        warnings = ("There is no signal in this frame.",) if dark else complaints(quality, match, misfit)
        explained = not dark and explains(quality, match, misfit)
        if not (explained and is_lit(quality)):
            eye = None
        quality |= {key: None for key in PRESUMED if key in quality and not (explained and is_measured(key, quality))}
        if eye is not None and (abs(eye.sphere_dpt) > 8 or eye.sd_dpt > 0.5):
            warnings += (f"The refraction of {-eye.sphere_dpt:+.1f} dpt (sd {eye.sd_dpt:.1f}) is uncertain.",)
        apart = ("saturated", "missing", "mean_dn", "noise_dn", "residual", "quality")
        return Report(
            method=recipe.method, bin=recipe.bin, rounds=climb.rounds_done, stopped=climb.stopped, seconds=seconds,
            psf_index=self.psf_index, psf_scale=climb.psf_scale,
            refraction_dpt=None if eye is None else {"sphere": -eye.sphere_dpt, "sd": eye.sd_dpt},
            regularisation={k: v for k, v in facts.items() if k not in apart},
            noise_dn=facts["noise_dn"] * recipe.bin, residual=facts.get("residual"),
            quality=quality, warnings=warnings,
        )  # fmt: skip


class _Climb:
    """One frame's way up the ladder, and what it met."""

    def __init__(
        self, owner: Reconstructor, counts: Pixels, dark: Pixels | None, deadline: Deadline | None, most: int | None,
        between: Between | None,
    ) -> None:  # fmt: skip
        self.clock, self.counts, self.dark = owner.clock, counts, dark
        self._defects = owner.defects
        self._found: dict[int, Places | None] = {}
        self.deadline, self.most, self.between = deadline, most, between
        self.last = owner.rungs[-1]
        self.channels = 1 if counts.ndim == 2 else counts.shape[2]
        self.done: _Rung = owner.rungs[0]
        self.facts: dict[str, Any] = {}
        self.rounds_done, self.stopped = 0, "done"
        self.refraction: Refraction | None = None
        self.focus_s, self.away_s, self.psf_scale = 0.0, 0.0, 1.0

    @property
    def sharp_dpt(self) -> float | None:
        """The mean sphere with which to see on; None where the stored PSF is as good as any."""
        eye = self.refraction
        return None if eye is None or eye.in_doubt else eye.sphere_dpt

    def fits(self, cost_s: float) -> bool:
        """Whether something of that cost fits into what is left."""
        return self.deadline is None or self.deadline.fits(cost_s)

    def cost_s(self, rung: _Rung) -> float:
        """What a rung takes at the least."""
        return self.channels * (rung.start_cost.seconds + rung.round_cost.seconds) + rung.finish_cost.seconds

    def brightest(self) -> ChannelFrame:
        """The channel with the most light."""
        return self.channel(0 if self.channels == 1 else int(np.argmax(np.nanmean(self.counts, axis=(0, 1)))))

    def channel(self, c: int) -> ChannelFrame:
        """Counts, dark frame and defective pixels of one channel; the defects are searched once per frame."""
        counts, dark = plane(self.counts, c), None if self.dark is None else plane(self.dark, c)
        if c not in self._found:
            self._found[c] = self._defects(counts, dark)
        return counts, dark, self._found[c]

    @property
    def known_defects(self) -> Places | None:
        """The pixels that are defective in any channel that was solved."""
        found = [places for places in self._found.values() if places is not None]
        return np.unique(np.concatenate(found)) if found else None

    def up(self, rung: _Rung) -> bool:
        """Solve one rung, channel by channel; False if it does not fit into what is left, and what was solved stays."""
        if self.facts and not self.fits(self.cost_s(rung)):
            self.stopped = "deadline"
            rung.doubt()
            return False
        if len(rung.planes) != self.channels:
            rung.planes = np.zeros((self.channels, *rung.grid.shape), np.float32)
        for c in range(self.channels):
            self._channel(rung, c)
        self.done = rung
        self.psf_scale = rung.scale
        return True

    def _channel(self, rung: _Rung, c: int) -> None:
        begin_s = self.clock.now_s()
        frame = rung.preparer(*self.channel(c))
        rung.solver.start(frame)
        now_s = self.clock.now_s()
        rung.start_cost.add(now_s - begin_s)
        self.stopped = "done"
        most = rung.most if self.most is None else min(self.most, rung.most)
        self.rounds_done = 0
        while self.rounds_done < most - (rung.solver.rounds == 1):
            if not self._fits_another(rung, self.channels - c):
                self.stopped = "deadline"
                break
            begin_s = now_s
            rung.solver.step()
            now_s = self.clock.now_s()
            rung.round_cost.add(now_s - begin_s)
            self.rounds_done += 1
            if self.between is not None and rung is self.last:
                now_s = self._rest(self.between, now_s)
        rung.solver.finish(rung.planes[c])
        self.facts = rung.solver.facts | {"saturated": frame.saturated, "missing": frame.missing}

    def _rest(self, between: Between, begin_s: float) -> float:
        """Let others do something; the deadline moves by what they took. The time after it."""
        between()
        now_s = self.clock.now_s()
        self.away_s += now_s - begin_s
        if self.deadline is not None:
            self.deadline = self.deadline.later(now_s - begin_s)
        return now_s

    def _fits_another(self, rung: _Rung, channels_left: int) -> bool:
        """Whether one more round fits, when the channels that are still to come get as much time as this one."""
        if self.deadline is None:
            return True
        others_s = (channels_left - 1) * (rung.start_cost.seconds + (self.rounds_done + 1) * rung.round_cost.seconds)
        return self.deadline.fits(rung.round_cost.seconds + others_s + rung.finish_cost.seconds)


def plane(image: Pixels, c: int) -> Pixels:
    """One channel, read-only: to compiled code that is part of the type, and only one of the two is compiled early."""
    image = image if image.ndim == 2 else image[..., c]
    plane: Pixels
    if image.dtype == np.uint16:
        plane = np.ascontiguousarray(image, np.uint16)[:]
    else:
        plane = np.ascontiguousarray(image, np.float32)[:]
    plane.flags.writeable = False  # of this view, not of the caller's array
    return plane
