"""Colour pictures: other colours of light, solved after the picture in the first one (green) and joined to it.

The picture in green is made first. The others follow: each is solved with its own PSF, stretched as green's was for the
refraction of the eye, and joined to green on green's grid (`colour`). Green leaves them the time of their first stage,
and no colour is left out for want of time: the pictures of a visit are in colour, or none is. NUMERICS.md 10.4. Raw
files without a green one have another first colour, `reference`.
"""

from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from device.clock import Deadline
from device.errors import FrameError
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.colour import ColourPicture, join_colours
from device.recon.durations import DurationEstimate
from device.recon.estimation.psf_warp import InterpolatedOtf, Wavefront, picture_otf, transform
from device.recon.frame_run import EyePsf
from device.recon.model.field_of_view import field_box, field_radius_px, lit_field
from device.recon.model.grid import Grid, disc
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.stage import RoundDone, Step
from device.recon.white_balance import balanced, white_ratios
from device.values import ChannelUse, Colour, Geometry, Image, Reconstruction, Report

NO_PSF = "the calibration has no PSF in this colour of light"
NO_PSF_CODE = "colour.psf"
NOT_REGISTERED = "{} could not be registered: no shift matches better than chance. It is shown where it was taken."


def without_psf(colour: Colour) -> ChannelUse:
    """Return the entry of a report for a colour of which the calibration has no PSF."""
    return ChannelUse(colour, None, reason=NO_PSF, code=NO_PSF_CODE)


@dataclass(frozen=True)
class ColourReconstruction(Reconstruction):
    """Reconstruction in green with a picture in colour.

    Attributes
    ----------
    colour
        Linear float32 (rows, cols, 3), red, green and blue, cropped to the illuminated field.
    others
        Report of each other colour.
    """

    colour: Image
    others: Mapping[Colour, Report]


class ColourReconstructor:
    """Solution of the frames in the other colours of light, and their joining to the picture in green.

    Between two steps the reconstructors may make quick looks of other frames. Not thread-safe.

    Parameters
    ----------
    green
        Reconstructor of the pictures in green, or in the light `reference`.
    others
        Reconstructor of each other colour: with the PSF of that colour, or `green` itself where one PSF
        holds for any colour; one of bursts where there are several frames.
    reference
        Colour of the pictures of `green`.
    timed
        True: measure the cost of joining on noise, for deadlines.
    """

    def __init__(
        self,
        green: Reconstructor,
        others: Mapping[Colour, Reconstructor | BurstReconstructor],
        *,
        reference: Colour = "green",
        timed: bool = True,
    ) -> None:
        calibration = green.calibration
        shape = green.shape
        self._calibration, self._reference = calibration, reference
        self.others = others
        self.clock = green.clock
        self.join_cost = DurationEstimate(green.stages[0].pace)
        self.singles = {
            colour: solver.single if isinstance(solver, BurstReconstructor) else solver
            for colour, solver in others.items()
        }
        self._otfs = {
            colour: InterpolatedOtf(solver.calibration.psfs[solver.psf_index])
            for colour, solver in self.singles.items()
            if solver is not green
        }
        self.box = field_box(calibration, shape)
        radius_px = field_radius_px(calibration)
        middle = ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
        self._field = disc(shape, middle, radius_px)[self.box].copy() if isfinite(radius_px) else None
        if others and timed:
            noise = np.random.default_rng(0).random(shape, np.float32)
            self._join({reference: noise, **dict.fromkeys(others, noise)}, 1, {})  # measures the cost

    def steps(
        self,
        green: Iterator[Step],
        frames: Mapping[Colour, Sequence[Pixels]],
        dark: Pixels | None = None,
        *,
        simulated: bool,
        deadline: Deadline | None = None,
        missing: Sequence[ChannelUse] = (),
        lights_dn_per_s: Mapping[Colour, float] | None = None,
    ) -> Iterator[Step]:
        """Yield the steps of `green`, RoundDone after each round of the other colours, and the picture in colour.

        The deadline moves by the time until the consumer continues after RoundDone. The first stage of each
        colour runs also after it (`deadline_of_green`).

        Parameters
        ----------
        green
            Steps of the picture in green.
        frames
            Frames of each other colour, (rows, cols).
        dark
            Dark frame of all of them; None: that of the calibration.
        simulated
            Mark that is copied to the result.
        deadline
            Time by which the picture is needed; None: all rounds.
        missing
            Colours without a frame, with their reasons.
        lights_dn_per_s
            Light of each colour at full drive in DN/s (`white_balance`); None if it is not known: the hue is
            then neutral.

        Yields
        ------
        StageResult, RoundDone or Reconstruction
            The last one is a ColourReconstruction if another colour was solved; its report lists every colour.
        """
        run = _Run(self, deadline)
        made = yield from run.green(green)
        eye = psf_wavefront(made.report, self._calibration.geometry)
        pictures: dict[Colour, Image] = {self._reference: made.picture}
        others = dict[Colour, Report]()
        gone = list(missing)
        for colour, counts in frames.items():
            try:
                solved = yield from run.solve(colour, counts, dark, eye)
            except FrameError as error:
                gone.append(ChannelUse(colour, None, reason=error.message, code=error.code))
                continue
            pictures[colour], others[colour] = solved.picture, solved.report
        if len(pictures) == 1:
            yield replace(made, report=replace(made.report, channels=(ChannelUse(self._reference, (0.0, 0.0)), *gone)))
            return
        begin_s = self.clock.now_s()
        joined = self._join(pictures, made.report.bin, lights_dn_per_s or {})
        seconds = made.report.seconds | {"colour": run.spent_s + self.clock.now_s() - begin_s}
        notes = tuple(NOT_REGISTERED.format(name) for name in joined.doubtful)
        report = replace(
            made.report, seconds=seconds, channels=(*joined.channels, *gone), warnings=(*made.report.warnings, *notes)
        )
        yield ColourReconstruction(made.picture, report, made.simulated or simulated, joined.picture, others)

    def deadline_of_green(self, deadline: Deadline, colours: Collection[Colour]) -> Deadline:
        """Return the deadline of the picture in green.

        Parameters
        ----------
        deadline
            Deadline of the picture in colour.
        colours
            Other colours.

        Returns
        -------
        Deadline
            Earlier by what `colours` take at least, at most by half.
        """
        firsts = [self.singles[colour].stages[0] for colour in colours]
        least_s = sum(first.start_cost.seconds + first.end_cost.seconds + first.finish_cost.seconds for first in firsts)
        return deadline.later(-min(least_s + (self.join_cost.seconds if firsts else 0.0), deadline.left_s() / 2))

    def _join(self, pictures: Mapping[Colour, Image], n: int, lights_dn_per_s: Mapping[Colour, float]) -> ColourPicture:
        """Return the channels, joined on the lit field only and balanced by the white reference.

        A field that is not calibrated is found in the picture of the reference.
        """
        begin_s = self.clock.now_s()
        cropped: dict[Colour, Image] = {
            name: np.ascontiguousarray(picture[self.box]) for name, picture in pictures.items()
        }
        field = self._field
        if field is None:
            reference = cropped[self._reference]
            field = lit_field(reference, Grid.periodic((reference.shape[0], reference.shape[1]), 1, inf))
        joined = join_colours(cropped, field, n)
        ratios = white_ratios(self._calibration, lights_dn_per_s)
        channels = tuple(replace(channel, white_ratio=ratios.get(channel.name)) for channel in joined.channels)
        picture = balanced(joined.picture, field, ratios)
        self.join_cost.add(self.clock.now_s() - begin_s)
        return replace(joined, picture=picture, channels=channels)

    def refocus(self, colour: Colour, eye: Wavefront | None) -> None:
        """Use the PSF of a colour for an eye in its last stage.

        A colour that shares green's reconstructor keeps the PSF of the last green picture.

        Parameters
        ----------
        colour
            Colour of light.
        eye
            Wavefront of the eye; None selects the stored PSF.
        """
        if colour not in self._otfs:
            return
        stage = self.singles[colour].stages[-1]
        otf = stage.model.stored
        if eye is not None and self._calibration.geometry is not None:
            otf = picture_otf(self._otfs[colour], stage.model, transform(self._calibration.geometry, *eye))
        stage.refocus(otf, eye)


def psf_wavefront(report: Report, geometry: Geometry | None) -> Wavefront | None:
    """Return the wavefront of the PSF that a report states; None for the stored PSF."""
    if geometry is None or (report.psf_scale == 1 and report.psf_cylinder is None):
        return None
    m_dpt = (1 - report.psf_scale) / geometry.scale_per_dpt
    cylinder = report.psf_cylinder
    if cylinder is None:
        return Wavefront(m_dpt)
    j0_dpt, j45_dpt = (float(cylinder[key] or 0.0) for key in ("j0_dpt", "j45_dpt"))  # of the correcting lens
    return Wavefront(m_dpt, -j0_dpt, j45_dpt)


class _Run:
    """State of one picture: time of the other colours, and deadline, which moves by the time of the consumer."""

    def __init__(self, owner: ColourReconstructor, deadline: Deadline | None) -> None:
        self._owner = owner
        self._deadline = deadline
        self.spent_s = 0.0

    def green(self, steps: Iterator[Step]) -> Generator[Step, None, Reconstruction]:
        """Yield the steps before the picture, and return the picture."""
        for step in steps:
            if isinstance(step, Reconstruction):
                return step
            yield from self._passed_on(step)
        raise AssertionError("a reconstruction ends with a picture")

    def solve(
        self, colour: Colour, frames: Sequence[Pixels], dark: Pixels | None, eye: Wavefront | None
    ) -> Generator[Step, None, Reconstruction]:
        """Yield RoundDone after each round of one colour, and return its picture; its PSF is that of `eye`.

        FrameError for useless frames.
        """
        owner = self._owner
        solver = owner.others[colour]
        begin_s = owner.clock.now_s()
        owner.refocus(colour, eye)
        deadline = None if self._deadline is None else self._deadline.later(-owner.join_cost.seconds)
        if isinstance(solver, BurstReconstructor):
            steps = solver.steps(frames, dark, simulated=True, deadline=deadline, eye_psf=EyePsf.KEPT)
        else:
            steps = solver.steps(frames[0], dark, simulated=True, deadline=deadline, eye_psf=EyePsf.KEPT)
        for step in steps:
            if isinstance(step, RoundDone):
                paused_s = owner.clock.now_s()
                yield from self._passed_on(step)
                begin_s += owner.clock.now_s() - paused_s
            elif isinstance(step, Reconstruction):
                self.spent_s += owner.clock.now_s() - begin_s
                return step
        raise AssertionError("a reconstruction ends with a picture")

    def _passed_on(self, step: Step) -> Iterator[Step]:
        """Yield a step; the deadline moves by the time until the consumer continues after RoundDone."""
        begin_s = self._owner.clock.now_s()
        yield step
        if self._deadline is not None and isinstance(step, RoundDone):
            self._deadline = self._deadline.later(self._owner.clock.now_s() - begin_s)
