"""Reconstruction of all frames of one capture as the instrument makes it: burst, other colours of light, dark frame.

The one path from files to the picture of a burst, for `diffuscope reconstruct` and `diffuscope archive`.

The solvers are those of a press (`device.recon.burst_reconstructor`, `colour_reconstructor`). They are planned once for
each calibration, frame shape and set of levels, so that many captures of one head follow each other at little cost.
"""

from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from device.clock import Deadline, SystemClock
from device.errors import FrameError
from device.recon.assessment.exposure_split import dark_fits
from device.recon.assessment.image_quality import NO_SIGNAL
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.colour_reconstructor import ColourReconstruction, ColourReconstructor
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.white_balance import light_dn_per_s
from device.values import Calibration, Colour, FrameUse, Image, Psf, Reconstruction, Report
from services.imaging.picture_files import read_raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.research.burst_frames import common_raw, rejections, unusable_raws, without_bad
from services.research.reconstruct_file import (
    FileReconstruction,
    FileReconstructor,
    doubts,
    file_report,
    plan_reconstructor,
    refuse_invalid,
)
from services.research.reconstruct_inputs import (
    LoadedPsfs,
    LoadedRaw,
    ReconstructOptions,
    Source,
    companion,
    companion_notes,
    load_calibrations,
    load_psfs,
    load_raw,
    without_unknown,
)

KEPT_PLANS = 2  # each has the solvers of a burst and of the other colours
NO_PSF = "the calibration has no PSF in this colour of light"
NOT_GREEN = "colours are joined to a picture in green light, and this one is in {} light"
Box = tuple[slice, slice]


@dataclass(frozen=True)
class CaptureFrames:
    """Raw frames of one capture: the burst `lit`, its reference first, and one frame in each other colour of light.

    `dark`: dark frame of the burst and, where it fits them, of the other colours; `light`: colour of the burst, None if
    it is unknown; `unusable`: reason of each frame of the burst that must not enter the picture, by its index;
    `full_drive_s`: exposure of the first frame in each light, seconds times the level of the lamp, where it is known.
    """

    lit: tuple[Source, ...]
    colours: Mapping[Colour, Source] = field(default_factory=dict)
    dark: Source | None = None
    dark_fits_colours: bool = True
    light: Colour | None = None
    unusable: Mapping[int, str] = field(default_factory=dict)
    full_drive_s: Mapping[Colour, float] = field(default_factory=dict)


def frames_of_capture(
    lit: Sequence[Source],
    colours: Mapping[Colour, Source],
    dark: Source | None = None,
    unusable: Mapping[int, str] | None = None,
) -> CaptureFrames:
    """Return the frames of a capture with the light and the exposures that its raw files state."""
    stated = stated_by(lit[0])
    light = None if stated is None or stated.illumination is None else stated.illumination.colour
    full_drive_s = {
        one.illumination.colour: one.exposure_s * one.illumination.level
        for one in map(stated_by, (lit[0], *colours.values()))
        if one is not None and one.illumination is not None and one.exposure_s is not None
    }
    fits = _dark_fits(lit[0] if dark is None else dark, colours.values())
    return CaptureFrames(tuple(lit), colours, dark, fits, light, unusable or {}, full_drive_s)


def _dark_fits(dark: Source, others: Iterable[Source]) -> bool:
    """Return True if the dark frame fits the frames in other colours of light, as far as they state an exposure."""
    dark_s, *others_s = (None if one is None else one.exposure_s for one in map(stated_by, (dark, *others)))
    return dark_s is None or all(one is None or dark_fits(one, dark_s) for one in others_s)


def stated_by(raw: Source) -> RawMetadata | None:
    """Return what a raw frame of the instrument states about itself; None for another file, or an array."""
    if not isinstance(raw, Path) or raw.suffix.lower() not in (".tif", ".tiff"):
        return None
    try:
        return read_raw_tiff(raw.read_bytes())[1]
    except (FrameError, OSError):
        return None


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

    `common` has the levels of all usable frames; `notes` are sentences about the files of the PSFs.
    """

    frames: CaptureFrames
    lit: tuple[LoadedRaw, ...]
    others: Mapping[Colour, LoadedRaw]
    unusable: Mapping[int, str]
    common: LoadedRaw
    plan: "_Plan"
    notes: tuple[str, ...]

    @property
    def usable(self) -> tuple[LoadedRaw, ...]:
        """Frames of the burst that may enter the picture."""
        return tuple(one for k, one in enumerate(self.lit) if k not in self.unusable)

    @property
    def psfs(self) -> tuple[Psf, ...]:
        """PSFs of the burst."""
        return self.plan.single.calibration.psfs


class CaptureReconstructor:
    """Reconstruction of the captures of one calibration; the options but `raw` hold for all of them. Not thread-safe.

    `colour_psfs` are the PSFs of the other colours, where the options have files of PSFs and no archived calibration.
    SettingError for invalid options.
    """

    def __init__(
        self,
        options: ReconstructOptions,
        planner: Planner | None = None,
        colour_psfs: Mapping[Colour, tuple[Path, ...]] | None = None,
    ) -> None:
        refuse_invalid(options)
        self._options, self._planner = options, planner or Planner(options.plans)
        self._colour_psfs = colour_psfs or {}
        self._singles: dict[Colour | None, FileReconstructor] = {}
        self._plans: OrderedDict[tuple[object, ...], _Plan] = OrderedDict()

    def __call__(self, frames: CaptureFrames) -> CaptureReconstruction:
        """Return the picture of a capture; FrameError or PsfError for frames that cannot be solved."""
        if len(frames.lit) == 1 and not frames.colours:
            return self._single(frames)
        return self.solve(self.load(frames))

    def load(self, frames: CaptureFrames) -> LoadedCapture:
        """Return the frames of a capture with planned solvers; FrameError if none can be used, or for colour raws."""
        lit = tuple(load_raw(source, self._options.bayer, checked=False) for source in frames.lit)
        unusable = {**unusable_raws(lit), **frames.unusable}
        if len(unusable) == len(lit):
            raise FrameError(f"no frame of the burst can be used; the first: {unusable[0]}", "Take it again.")
        common = common_raw([one for k, one in enumerate(lit) if k not in unusable])
        others = {name: load_raw(source) for name, source in frames.colours.items()}
        _refuse_different(common, others)
        plan, notes = self._plan(common, frames)
        return LoadedCapture(frames, lit, others, unusable, common, plan, notes)

    def solve(self, loaded: LoadedCapture) -> CaptureReconstruction:
        """Return the picture of a loaded capture; FrameError for frames that cannot be solved."""
        frames, common = loaded.frames, loaded.common
        dark = None if frames.dark is None else companion(frames.dark, "the dark frame", common)
        lit = [without_unknown(without_bad(one.raw), dark)[0] for one in loaded.lit]
        others = {name: without_unknown(without_bad(one.raw), dark)[0] for name, one in loaded.others.items()}
        dark = None if dark is None else np.nan_to_num(dark)
        made = loaded.plan.solve(
            lit, loaded.unusable, dark, others, dark if frames.dark_fits_colours else None, frames.full_drive_s
        )
        return self._reported(made, loaded.plan, [*loaded.lit, *loaded.others.values()], loaded.notes)

    def _single(self, frames: CaptureFrames) -> CaptureReconstruction:
        """Return the picture of one frame, with the solver of one frame."""
        if frames.light not in self._singles:
            options = replace(self._options, light=frames.light)
            self._singles[frames.light] = FileReconstructor(options, self._planner)
        solver = self._singles[frames.light]
        made = solver(frames.lit[0], frames.dark)
        return CaptureReconstruction(made, solver.box)

    def _plan(self, common: LoadedRaw, frames: CaptureFrames) -> tuple["_Plan", tuple[str, ...]]:
        """Return the solvers for the levels of a capture, and notes about the files of the PSFs."""
        psfs = self._psfs(self._options, common)
        raw, light = common.raw, frames.light
        whole = self._calibration(self._options, common, psfs)
        green = whole if light is None else whole.for_colour(light)
        index = most_likely_psf(green, raw.pixels, self._planner)[0] if len(green.psfs) > 1 else 0
        levels = (raw.white_dn, raw.shift, raw.stored_bits, common.black_dn, common.simulated)
        key = (common.solved_shape, *levels, light, index, tuple(sorted(frames.colours)))
        if key not in self._plans:
            others = {name: self._of_colour(name, common, whole, green, light) for name in frames.colours}
            self._plans[key] = _Plan(self._options, green, others, common.solved_shape, self._planner, index)
            while len(self._plans) > KEPT_PLANS:
                self._plans.popitem(last=False)
        self._plans.move_to_end(key)
        return self._plans[key], () if psfs is None else psfs.notes

    def _of_colour(
        self, name: Colour, common: LoadedRaw, whole: Calibration, green: Calibration, light: Colour | None
    ) -> Calibration | str:
        """Return the calibration of another colour, `green` itself if its PSF holds for any colour, or why none fits.

        It is that of the instrument: PSFs of that colour, else those that hold for any colour.
        """
        if light not in (None, "green"):
            return NOT_GREEN.format(light)
        if name in self._colour_psfs:
            options = replace(self._options, psfs=self._colour_psfs[name])
            return self._calibration(options, common, self._psfs(options, common))
        measured = {psf.colour for psf in whole.psfs}
        if name in measured:
            return whole.for_colour(name)
        return green if None in measured else NO_PSF

    def _psfs(self, options: ReconstructOptions, common: LoadedRaw) -> LoadedPsfs | None:
        return None if options.calibration is not None else load_psfs(options, common, per_channel=False)

    def _calibration(self, options: ReconstructOptions, common: LoadedRaw, psfs: LoadedPsfs | None) -> Calibration:
        return load_calibrations(options, common, psfs)[0]

    def _reported(
        self, made: Reconstruction, plan: "_Plan", loaded: Sequence[LoadedRaw], notes: tuple[str, ...]
    ) -> CaptureReconstruction:
        """Return the result with the report of a file; FrameError for a picture without signal."""
        if NO_SIGNAL in made.report.warnings:
            raise FrameError(f"{loaded[0].name} holds no signal above the black level", "Give frames taken with light.")
        count = len(made.report.frames)
        of_raws = [note for one in loaded for note in one.notes]
        of_companions = companion_notes(self._options, plan.single.calibration)
        texts = (
            *doubts(made.report, plan.single, of_raws),
            *rejections(loaded[:count], made.report.frames),
            *notes,
            *of_companions,
            *of_raws,
        )
        report = file_report(made.report, plan.single, self._options)
        report = replace(report, warnings=tuple(dict.fromkeys((*report.warnings, *texts))))
        simulated = made.simulated or plan.single.calibration.simulated or any(one.simulated for one in loaded)
        colour = made.colour if isinstance(made, ColourReconstruction) else None
        box = field_box(plan.single.calibration, plan.single.shape)
        return CaptureReconstruction(FileReconstruction(made.picture, report, simulated), box, colour)


def _refuse_different(common: LoadedRaw, others: Mapping[Colour, LoadedRaw]) -> None:
    """Raise FrameError for a frame in another colour that has another size, number of channels or kind of levels."""
    for name, one in others.items():
        if (one.shape, one.channels, one.raw.shift) != (common.shape, common.channels, common.raw.shift):
            raise FrameError(
                f"{one.name}, in {name} light, has another size or other levels than {common.name}",
                "Give the frames of one capture, in one and the same camera mode.",
            )


class _Plan:
    """Solvers of captures of one set of levels: of one frame, of the burst, and of the other colours."""

    def __init__(
        self,
        options: ReconstructOptions,
        green: Calibration,
        others: Mapping[Colour, Calibration | str],
        shape: tuple[int, int],
        planner: Planner,
        index: int,
    ) -> None:
        self._budget_s, self._clock = options.budget_s, SystemClock()
        self.single = plan_reconstructor(options, green, shape, planner, index, quick=True)
        self._bursts = BurstReconstructor(self.single, planner, timed=self._budget_s is not None)
        like_green = replace(options, bin=self.single.stages[-1].recipe.bin)
        self._missing = {name: why for name, why in others.items() if isinstance(why, str)}
        solvers: dict[Colour, Reconstructor] = {}
        for name, own in others.items():
            if own is green:
                solvers[name] = self.single
            elif isinstance(own, Calibration):
                nearest = min(index, len(own.psfs) - 1)
                solvers[name] = plan_reconstructor(like_green, own, shape, planner, nearest, quick=True, main=False)
        self._colours = ColourReconstructor(self.single, solvers) if others else None

    def solve(
        self,
        lit: Sequence[Pixels],
        unusable: Mapping[int, str],
        dark: Image | None,
        others: Mapping[Colour, Pixels],
        others_dark: Image | None,
        full_drive_s: Mapping[Colour, float],
    ) -> Reconstruction:
        """Return the picture, with `colour` if another colour was solved; at least one frame of the burst is usable."""
        deadline = None if self._budget_s is None else Deadline.after(self._clock, self._budget_s)
        order = sorted(range(len(lit)), key=lambda k: k in unusable)  # the first one must be usable
        reasons = {place: unusable[k] for place, k in enumerate(order) if k in unusable}
        steps = self._bursts.steps([lit[k] for k in order], dark, simulated=False, deadline=deadline, unusable=reasons)
        if self._colours is not None:
            solved = {name: counts for name, counts in others.items() if name not in self._missing}
            lights = self._lights_dn_per_s({**solved, "green": lit[order[0]]}, dark, others_dark, full_drive_s)
            steps = self._colours.steps(
                steps,
                solved,
                others_dark,
                simulated=False,
                deadline=deadline,
                missing=self._missing,
                lights_dn_per_s=lights,
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
            name: light_dn_per_s(counts, dark if name == "green" else others_dark, calibration, full_drive_s[name])
            for name, counts in frames.items()
            if calibration.white is not None and name in full_drive_s
        }


def _in_given_order(report: Report, order: Sequence[int]) -> tuple[FrameUse, ...]:
    """Return the use of the frames with the indices in which they were given."""
    return tuple(sorted((replace(one, index=order[one.index]) for one in report.frames), key=lambda one: one.index))
