"""Reconstruction of all frames of one capture as the instrument makes it: burst, other colours of light, dark frame.

The one path from files to the picture of a burst, for `diffuscope reconstruct` and `diffuscope archive`.

The solvers are those of a press (`device.recon.burst_reconstructor`, `colour_reconstructor`). They are planned once for
each calibration, frame shape and set of levels, so that many captures of one head follow each other at little cost.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from device.clock import Deadline, SystemClock
from device.errors import FrameError
from device.recon.assessment.exposure_split import dark_fits
from device.recon.assessment.quality_figures import NO_SIGNAL
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.colour_reconstructor import ColourReconstruction, ColourReconstructor, without_psf
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.white_balance import light_dn_per_s
from device.values import Calibration, ChannelUse, Colour, FrameUse, Image, Psf, Reconstruction, Report
from services.lru_cache import LruCache
from services.research.burst_frames import common_raw, refuse_other_size, rejections, unusable_raws, without_bad
from services.research.given_field import NO_DISC, LitField, has_time_again, is_doubtful, smaller_field
from services.research.reconstruct_file import (
    FileReconstruction,
    FileReconstructor,
    doubts,
    file_report,
    plan_reconstructor,
    without_psf_figures,
)
from services.research.reconstruct_inputs import (
    LoadedRaw,
    ReconstructOptions,
    Source,
    companion,
    companion_notes,
    in_light,
    load_calibrations,
    load_psfs,
    load_raw,
    stated_by,
    stated_light,
    without_unknown,
)

KEPT_PLANS = 2  # each has the solvers of a burst and of the other colours
Box = tuple[slice, slice]


@dataclass(frozen=True)
class CaptureFrames:
    """Raw frames of one capture: the burst `lit`, its reference first, and the frames in each other colour of light.

    `dark`: dark frame of the burst and, where it fits them, of the other colours; `light`: colour of the burst, None if
    it is unknown; `unusable`: reason of each frame of the burst that must not enter the picture, by its index;
    `full_drive_s`: exposure of the first frame in each light, seconds times the level of the lamp, where it is known.
    """

    lit: tuple[Source, ...]
    colours: Mapping[Colour, Sequence[Source]] = field(default_factory=dict)
    dark: Source | None = None
    dark_fits_colours: bool = True
    light: Colour | None = None
    unusable: Mapping[int, str] = field(default_factory=dict)
    full_drive_s: Mapping[Colour, float] = field(default_factory=dict)


def frames_of_capture(
    lit: Sequence[Source],
    colours: Mapping[Colour, Sequence[Source]],
    dark: Source | None = None,
    unusable: Mapping[int, str] | None = None,
    light: Colour | None = None,
) -> CaptureFrames:
    """Return the frames of a capture with the light (unless given) and the exposures that its raw files state."""
    others = [source for frames in colours.values() for source in frames]
    full_drive_s = {
        metadata.illumination.colour: metadata.exposure_s * metadata.illumination.level
        for metadata in map(stated_by, (*reversed(others), lit[0]))
        if metadata is not None and metadata.illumination is not None and metadata.exposure_s is not None
    }
    fits = _dark_fits(lit[0] if dark is None else dark, others)
    return CaptureFrames(tuple(lit), colours, dark, fits, light or stated_light(lit[0]), unusable or {}, full_drive_s)


def _dark_fits(dark: Source, others: Iterable[Source]) -> bool:
    """Return True if the dark frame fits the frames in other colours of light, as far as they state an exposure."""
    dark_s, *others_s = (
        None if metadata is None else metadata.exposure_s for metadata in map(stated_by, (dark, *others))
    )
    return dark_s is None or all(exposure_s is None or dark_fits(exposure_s, dark_s) for exposure_s in others_s)


@dataclass(frozen=True)
class CaptureReconstruction:
    """Picture of a capture, (rows, cols) of the sensor; `box`: rows and columns of its lit field.

    `colour`: the picture in colour, cropped to that field, linear float32 (rows, cols, 3); None without one.
    """

    made: FileReconstruction
    box: Box
    colour: Image | None = None


@dataclass(frozen=True)
class LoadedCapture:
    """Frames of a capture as they are solved, with the reason of each unusable one by its index in `lit`.

    `common` has the levels of all usable frames; `notes` are sentences about the files of the PSFs; `selected_s` is the
    duration of the choice among several PSFs, which is part of a time budget.
    """

    frames: CaptureFrames
    lit: tuple[LoadedRaw, ...]
    others: Mapping[Colour, tuple[LoadedRaw, ...]]
    unusable: Mapping[int, str]
    common: LoadedRaw
    plan: "_CaptureSolvers"
    notes: tuple[str, ...]
    selected_s: float

    @property
    def usable(self) -> tuple[LoadedRaw, ...]:
        """Frames of the burst that may enter the picture."""
        return tuple(frame for k, frame in enumerate(self.lit) if k not in self.unusable)

    @property
    def whole(self) -> tuple[LoadedRaw, ...]:
        """All frames: those of the burst, and those of the other colours."""
        return (*self.lit, *(frame for frames in self.others.values() for frame in frames))

    @property
    def psfs(self) -> tuple[Psf, ...]:
        """PSFs of the burst."""
        return self.plan.single.calibration.psfs


class CaptureReconstructor:
    """Reconstruction of the captures of one calibration with the same options. Not thread-safe.

    `of_colours` are the options of the other colours, with PSFs and dark frame of their own, where `options` has files
    of PSFs and no archived calibration. SettingError for invalid options.
    """

    def __init__(
        self,
        options: ReconstructOptions,
        planner: Planner | None = None,
        of_colours: Mapping[Colour, ReconstructOptions] | None = None,
    ) -> None:
        self._options = options
        self._planner = planner or Planner(options.plans)
        self._clock = SystemClock()
        self._single = FileReconstructor(options, self._planner)
        self._of_colours = of_colours or {}
        self._plans = LruCache[tuple[object, ...], _CaptureSolvers](KEPT_PLANS)

    def __call__(self, frames: CaptureFrames) -> CaptureReconstruction:
        """Return the picture of a capture; FrameError or PsfError for frames that cannot be solved."""
        if len(frames.lit) == 1 and not frames.colours:
            made = self._single(frames.lit[0], frames.dark)
            return CaptureReconstruction(made, self._single.box)
        return self.solve(self.load(frames))

    def load(self, frames: CaptureFrames) -> LoadedCapture:
        """Return the frames of a capture with planned solvers; FrameError if none can be used, or for colour raws."""
        lit = tuple(
            load_raw(source, self._options.bayer, checked=False, gamma=self._options.gamma) for source in frames.lit
        )
        unusable = {**unusable_raws(lit), **frames.unusable}
        if len(unusable) == len(lit):
            raise FrameError(f"no frame of the burst can be used; the first: {unusable[0]}", "Take it again.")
        common = common_raw([frame for k, frame in enumerate(lit) if k not in unusable])
        others = {
            name: tuple(load_raw(source, gamma=self._options.gamma) for source in sources)
            for name, sources in frames.colours.items()
        }
        _refuse_different(common, others)
        plan, notes, selected_s = self._plan(
            common,
            {name: common_raw(given) for name, given in others.items()},
            frames,
            self._options.field_deg,
        )
        return LoadedCapture(frames, lit, others, unusable, common, plan, notes, selected_s)

    def solve(self, loaded: LoadedCapture) -> CaptureReconstruction:
        """Return the picture of a loaded capture; FrameError for frames that cannot be solved."""
        made = self._solved(loaded)
        field = self._smaller_field(made.report, loaded)
        has_time = has_time_again(made.report, self._options)
        if field is not None and field.diameter_deg is not None and has_time:
            others = {name: common_raw(given) for name, given in loaded.others.items()}
            plan, *_ = self._plan(loaded.common, others, loaded.frames, field.diameter_deg)
            loaded = replace(loaded, plan=plan)
            made = self._solved(loaded)
        solved = self._reported(made, loaded)
        if field is None:
            return solved
        report = solved.made.report
        report = replace(report, warnings=(*report.warnings, field.note(has_time)))
        report = report if field.diameter_deg is not None else without_psf_figures(report, NO_DISC)
        return replace(solved, made=replace(solved.made, report=report))

    def _smaller_field(self, report: Report, loaded: LoadedCapture) -> LitField | None:
        """Return the lit disc of the reference where it is smaller than the field; SettingError where it is larger."""
        if not is_doubtful(report, self._options):
            return None
        reference = next(frame for frame, use in zip(loaded.lit, report.frames, strict=True) if use.used)
        calibration = loaded.plan.single.calibration
        return smaller_field(self._options, calibration, reference.raw.pixels, self._planner, report)

    def _solved(self, loaded: LoadedCapture) -> Reconstruction:
        """Return the picture of a loaded capture with the report of its solver."""
        frames = loaded.frames
        common = loaded.common
        dark = None if frames.dark is None else companion(frames.dark, "the dark frame", common)
        lit = [without_unknown(without_bad(frame.raw), dark)[0] for frame in loaded.lit]
        others = {
            name: [without_unknown(without_bad(frame.raw), dark)[0] for frame in given]
            for name, given in loaded.others.items()
        }
        dark = None if dark is None else np.nan_to_num(dark)
        return loaded.plan.solve(
            lit,
            loaded.unusable,
            dark,
            others,
            dark if frames.dark_fits_colours else None,
            frames.full_drive_s,
            loaded.selected_s,
        )

    def _plan(
        self,
        common: LoadedRaw,
        others: Mapping[Colour, LoadedRaw],
        frames: CaptureFrames,
        field_deg: float | None,
    ) -> tuple["_CaptureSolvers", tuple[str, ...], float]:
        """Return the solvers for the levels of a capture, notes about the files of the PSFs, and seconds of the choice.

        `common` and `others` have the levels of all frames of a colour.
        """
        whole, notes = self._calibration(self._options, common, field_deg)
        reference = in_light(whole, frames.light, common.name)
        begin_s = self._clock.now_s()
        index = most_likely_psf(reference, common.raw.pixels, self._planner)[0] if len(reference.psfs) > 1 else 0
        selected_s = self._clock.now_s() - begin_s
        counts = tuple((name, len(given) > 1, _levels(others[name])) for name, given in sorted(frames.colours.items()))
        key = field_deg, common.solved_shape, _levels(common), len(frames.lit) > 1, frames.light, index, counts

        def plan() -> _CaptureSolvers:
            calibrations = {
                name: self._of_colour(name, raw, whole, reference, field_deg) for name, raw in others.items()
            }
            return _CaptureSolvers(self._options, reference, calibrations, frames, self._planner, index)

        return self._plans.get_or_make(key, plan), notes, selected_s

    def _of_colour(
        self,
        name: Colour,
        loaded: LoadedRaw,
        whole: Calibration,
        reference: Calibration,
        field_deg: float | None,
    ) -> Calibration | ChannelUse:
        """Return the calibration of another colour, `reference` if its PSF holds for any colour, or why none fits.

        It is that of the instrument: PSFs of that colour, else those that hold for any colour.
        """
        if name in self._of_colours:
            return self._calibration(self._of_colours[name], loaded, field_deg)[0]
        measured = {psf.colour for psf in whole.psfs}
        if name in measured:
            return whole.for_colour(name)
        return reference if None in measured else without_psf(name)

    def _calibration(
        self, options: ReconstructOptions, common: LoadedRaw, field_deg: float | None
    ) -> tuple[Calibration, tuple[str, ...]]:
        """Return the calibration of the options for a raw with this field, and notes about the files of the PSFs."""
        psfs = None if options.calibration is not None else load_psfs(options, common, per_channel=False)
        (calibration,) = load_calibrations(replace(options, field_deg=field_deg), common, psfs)
        return calibration, () if psfs is None else (*psfs.notes, *psfs.damage)

    def _reported(self, made: Reconstruction, loaded: LoadedCapture) -> CaptureReconstruction:
        """Return the result with the report of a file; FrameError for a picture without signal."""
        plan = loaded.plan
        frames = made.report.frames
        if NO_SIGNAL in made.report.warnings:
            raise FrameError(
                f"{loaded.lit[0].name} holds no signal above the black level", "Give frames taken with light."
            )
        of_raws = [note for frame in loaded.whole for note in frame.notes]
        texts = [
            *doubts(made.report, plan.single, of_raws),
            *rejections(loaded.lit, frames),
            *(_of_colours(made, loaded) if isinstance(made, ColourReconstruction) else ()),
            *loaded.notes,
            *companion_notes(self._options, plan.single.calibration),
            *of_raws,
        ]
        report = file_report(made.report, plan.single, self._options)
        report = replace(report, warnings=tuple(dict.fromkeys((*report.warnings, *texts))))
        simulated = (
            made.simulated or plan.single.calibration.simulated or any(frame.simulated for frame in loaded.whole)
        )
        colour = made.colour if isinstance(made, ColourReconstruction) else None
        box = field_box(plan.single.calibration, plan.single.shape)
        return CaptureReconstruction(FileReconstruction(made.picture, report, simulated), box, colour)


def _levels(loaded: LoadedRaw) -> tuple[object, ...]:
    raw = loaded.raw
    return raw.white_dn, raw.shift, raw.stored_bits, loaded.black_dn, loaded.simulated


def _of_colours(made: ColourReconstruction, loaded: LoadedCapture) -> list[str]:
    """Return what the other colours have to say: their warnings, frames that were left out, what is predicted."""
    notes = []
    for name, report in made.others.items():
        single = loaded.plan.singles[name]
        words = (
            *report.warnings,
            *doubts(report, single, [note for frame in loaded.others[name] for note in frame.notes]),
        )
        notes += [f"{name}: {warning}" for warning in words]
        notes += rejections(loaded.others[name], report.frames)
    predicted = [channel.name for channel in made.report.channels if channel.predicted]
    return [*notes, *(f"{name} is predicted from the other colours, not measured." for name in predicted)]


def _refuse_different(common: LoadedRaw, others: Mapping[Colour, Sequence[LoadedRaw]]) -> None:
    """Raise FrameError for a frame in another colour that has another size or kind of levels, or colours."""
    for name, frames in others.items():
        for frame in frames:
            refuse_other_size(frame, common)
            if frame.raw.shift != common.raw.shift:
                raise FrameError(
                    f"{frame.name}, in {name} light, has other levels than {common.name}",
                    "Give the frames of one capture, in one and the same camera mode.",
                )


class _CaptureSolvers:
    """Solvers of captures of one set of levels: of the first colour and of the others, each of one frame or a burst."""

    def __init__(
        self,
        options: ReconstructOptions,
        reference: Calibration,
        others: Mapping[Colour, Calibration | ChannelUse],
        frames: CaptureFrames,
        planner: Planner,
        index: int,
    ) -> None:
        self._budget_s = options.budget_s
        self._clock = SystemClock()
        self._light = frames.light or "green"
        self._timed = self._budget_s is not None
        self._planner = planner
        shape = reference.psfs[0].pixels.shape
        self.single = plan_reconstructor(options, reference, shape, planner, index, quick=len(frames.lit) > 1)
        self._lit = self._of_frames(self.single, len(frames.lit))
        like_first = replace(options, bin=self.single.stages[-1].recipe.bin)
        self._missing = [own for own in others.values() if isinstance(own, ChannelUse)]
        solvers: dict[Colour, Reconstructor | BurstReconstructor] = {}
        for name, own in others.items():
            count = len(frames.colours[name])
            if own is reference:
                solvers[name] = self._of_frames(self.single, count)
            elif isinstance(own, Calibration):
                nearest = min(index, len(own.psfs) - 1)
                single = plan_reconstructor(like_first, own, shape, planner, nearest, quick=count > 1, refract=False)
                solvers[name] = self._of_frames(single, count)
        self._colours = None
        if others:
            self._colours = ColourReconstructor(self.single, solvers, reference=self._light, timed=self._timed)

    def _of_frames(self, single: Reconstructor, count: int) -> Reconstructor | BurstReconstructor:
        return single if count == 1 else BurstReconstructor(single, self._planner, timed=self._timed)

    @property
    def singles(self) -> Mapping[Colour, Reconstructor]:
        """Solvers of one frame in each other colour."""
        return {} if self._colours is None else self._colours.singles

    def solve(
        self,
        lit: Sequence[Pixels],
        unusable: Mapping[int, str],
        dark: Image | None,
        others: Mapping[Colour, Sequence[Pixels]],
        others_dark: Image | None,
        full_drive_s: Mapping[Colour, float],
        selected_s: float,
    ) -> Reconstruction:
        """Return the picture, with `colour` if another colour was solved; at least one frame of the burst is usable."""
        deadline = None
        if self._budget_s is not None:
            deadline = Deadline.after(self._clock, self._budget_s).later(-selected_s)
        order = sorted(range(len(lit)), key=lambda k: k in unusable)  # the first one must be usable
        reasons = {place: unusable[k] for place, k in enumerate(order) if k in unusable}
        solved = (
            {} if self._colours is None else {name: others[name] for name in others if name in self._colours.others}
        )
        of_green = deadline
        if self._colours is not None and deadline is not None:
            of_green = self._colours.deadline_of_green(deadline, solved)
        if isinstance(self._lit, BurstReconstructor):
            ordered = [lit[k] for k in order]
            steps = self._lit.steps(ordered, dark, simulated=False, deadline=of_green, unusable=reasons)
        else:
            steps = self._lit.steps(lit[0], dark, simulated=False, deadline=of_green)
        if self._colours is not None:
            first = {self._light: lit[order[0]], **{name: given[0] for name, given in solved.items()}}
            steps = self._colours.steps(
                steps,
                solved,
                others_dark,
                simulated=False,
                deadline=deadline,
                missing=self._missing,
                lights_dn_per_s=self._lights_dn_per_s(first, dark, others_dark, full_drive_s),
            )
        (made,) = deque(steps, maxlen=1)
        assert isinstance(made, Reconstruction)
        return replace(made, report=replace(made.report, frames=_in_given_order(made.report, order)))

    def _lights_dn_per_s(
        self,
        frames: Mapping[Colour, Pixels],
        dark: Image | None,
        others_dark: Image | None,
        full_drive_s: Mapping[Colour, float],
    ) -> dict[Colour, float]:
        """Return the light of each colour at full drive; none without a white reference to compare with."""
        calibration = self.single.calibration
        return {
            name: light_dn_per_s(counts, dark if name == self._light else others_dark, calibration, full_drive_s[name])
            for name, counts in frames.items()
            if calibration.white is not None and name in full_drive_s
        }


def _in_given_order(report: Report, order: Sequence[int]) -> tuple[FrameUse, ...]:
    """Return the use of the frames with the indices in which they were given."""
    return tuple(sorted((replace(use, index=order[use.index]) for use in report.frames), key=lambda use: use.index))
