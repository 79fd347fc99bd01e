"""`diffuscope reconstruct`: deconvolution of one raw frame to one picture, with the instrument's solver.

`FileReconstructor` is the one implementation for files and arrays, for one frame and for many (`reconstruct_each`).
"""

import errno
import json
import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import cast, get_args

import numpy as np

from device.clock import Deadline, SystemClock
from device.config import bayer
from device.config.bayer import BayerOption
from device.config.marked_files import KEY, write_linear
from device.errors import FrameError, SettingError, StoreError, StoreFull
from device.recon.assessment.psf_consistency import PsfConsistency
from device.recon.assessment.quality_figures import (
    LITTLE_LIGHT,
    MISMATCHES,
    NO_SIGNAL,
    PARTLY_LIT,
    PSF_FIGURES,
    UNEXPLAINED,
    Audience,
    states_misfit,
)
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.estimation.refraction.estimator import NoRefraction
from device.recon.estimation.refraction.notation import report_of
from device.recon.estimation.row_order import ROWS_REMEDY
from device.recon.frames import plane
from device.recon.installed_methods import find_method
from device.recon.method_settings import Settings, check_settings
from device.recon.methods import METHODS, Method
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box, field_radius_px
from device.recon.model.grid import disc
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.solvers.flat_field_correction import flat_field_correct
from device.recon.stage import Recipe, default_schedule
from device.values import Calibration, Image, Reconstruction, Report
from services.imaging.colour_rendering import render_colour
from services.imaging.picture_files import DISPLAY, to_png
from services.lru_cache import LruCache
from services.research import sweep_plot
from services.research.given_field import NO_DISC, LitField, has_time_again, is_doubtful, smaller_field
from services.research.reconstruct_inputs import (
    LoadedPsfs,
    LoadedRaw,
    RawSource,
    ReconstructOptions,
    Shape,
    Source,
    companion,
    companion_notes,
    head_notes,
    load_calibrations,
    load_psfs,
    load_raw,
    stated_light,
    swap_notes,
    without_unknown,
)

ENDINGS = (".npy", ".tif", ".tiff", ".png")
MIN_SAMPLES = 16  # of the shorter side
MAX_ROUNDS = 100_000
MIN_GAMMA, MAX_GAMMA = 0.2, 5.0
MAX_FILLED = 5e-4  # share of missing pixels that a periodic method fills: at 0.1 % it loses a third of the PCC
MAX_RESIDUAL = 3.0  # times the noise; 1 in frames that the model explains
ONCE = "FFTW_ESTIMATE"  # plans of one picture: to measure them takes longer than the picture. Measured ones are used
KEPT_PLANS = 4  # a recording changes between few sets of levels; each takes up to about 300 MB at full sensor size


@dataclass(frozen=True)
class FileReport(Report):
    """Report of `diffuscope reconstruct`: that of the solver, with what was set and what the files were.

    The other figures of several PSFs are those of the brightest channel.
    """

    solved: Shape = (0, 0)
    """Rows and columns of the solved frame, in samples of bin x bin pixels."""

    given: dict[str, float | str | dict[str, float]] = field(default_factory=dict)
    """Options that replaced a choice of the program, by name; those of the method are in `settings`."""

    psf_channels: int = 1
    """Number of PSFs for the channels of the raw; 1: one PSF for all."""

    bayer: str | None = None
    """Pattern of the colour mosaic, for example rggb; null for a raw without a mosaic."""


@dataclass(frozen=True)
class FileReconstruction(Reconstruction):
    """Picture of a raw frame, linear float32 in DN, rows x cols (x 3) of the raw, with its report.

    Attributes
    ----------
    report
        Figures of the solver, what was set, and what the files were.
    """

    report: FileReport

    @property
    def summary(self) -> str:
        """Summary in one line, with method, bin, size on which the frame was solved, and seconds."""
        report = self.report
        rows, cols = report.solved
        seconds = sum(report.seconds.values())
        return f"{report.method}, bin {report.bin}, solved on {rows} x {cols} by FFTW, {seconds:.3f} s"

    @property
    def refraction_words(self) -> str | None:
        """Refraction in one line with what fixes its zero; None without one."""
        refraction = self.report.refraction_dpt or {}
        if refraction.get("sphere") is None:
            return None
        sphere, sd, zero = (refraction[key] for key in ("sphere", "sd", "zero"))
        known = f"zero by the {zero}" if zero != "relative" else "relative to the PSF, whose zero is not known"
        return f"refraction {sphere:+.2f} dpt (sd {sd:.2f}), {known}"

    def save(self, path: str | Path) -> None:
        """Write the picture, marked if it is simulated.

        Parameters
        ----------
        path
            File: .png scaled for eyes, .tiff or .npy linear float32.

        Raises
        ------
        SettingError
            The ending is unknown, or the folder does not exist.
        StoreError
            The file cannot be written.
        """
        place = Path(path)
        refuse_output(place)
        write_picture(place, self.picture, self.simulated)

    def report_json(self) -> str:
        """Return the report as the text of a JSON file.

        Returns
        -------
        str
            JSON with the fields of the report, and the mark of a simulated picture.
        """
        return json.dumps(asdict(self.report) | {KEY: self.simulated}, indent=1) + "\n"


@dataclass(frozen=True)
class OutputFiles:
    """Files of a reconstruction, its picture and its report; one that is None is not written."""

    picture: Path | None = None
    report: Path | None = None


NO_FILES = OutputFiles()


def one_picture_reconstructor(options: ReconstructOptions) -> "FileReconstructor":
    """Return the reconstruction of one picture: its FFTs are planned by estimate, unless a budget limits its time."""
    return FileReconstructor(options, None if options.budget_s else Planner(options.plans, effort=ONCE))


def reconstruct_file(raw: Source, options: ReconstructOptions, output: OutputFiles = NO_FILES) -> FileReconstruction:
    """Reconstruct a raw, write picture and sweep plot; return the result before the `even` correction.

    The report is not written here. Invalid options raise an error before any computation.
    """
    reconstruct = one_picture_reconstructor(options)
    refuse_outputs(output, (raw,), options)
    made = reconstruct(raw)
    if output.picture is not None:
        write_picture(output.picture, reconstruct.evened(made.picture), made.simulated)
    return made


class FileReconstructor:
    """Reconstruction of the raw frames of one recording with the same options.

    PSFs are read once for each shape of raw, and a solver is planned once for each shape and set of levels; KEPT_PLANS
    are kept. Not thread-safe. `planner` replaces the one that keeps its FFT plans in `options.plans`. `timed` False: a
    budget adds the quick look but no deadline. SettingError for invalid options.
    """

    def __init__(self, options: ReconstructOptions, planner: Planner | None = None, *, timed: bool = True) -> None:
        refuse_invalid(options)
        self._options = options
        self._timed = timed
        self._planner = planner or Planner(options.plans)
        self._psfs: dict[tuple[Shape, int, str | None], LoadedPsfs | None] = {}
        self._plans = LruCache[tuple[object, ...], _FrameSolvers](KEPT_PLANS)
        self._last: _FrameSolvers | None = None

    def __call__(self, source: RawSource, dark: Source | None = None) -> FileReconstruction:
        """Return the picture of a raw, a file or an array; FrameError or PsfError for one that cannot be solved.

        `dark`: the dark frame of this raw alone, (rows, cols) of it.
        """
        light = None if self._options.calibration is None else stated_light(source)
        loaded = replace(load_raw(source, self._options.bayer, gamma=self._options.gamma), light=light)
        psfs = self._psfs_for(loaded)
        plan = self._plan(loaded, psfs, self._options.field_deg)
        made = self._solved(plan, loaded, dark)
        field = plan.smaller_field(made.report, loaded)
        has_time = has_time_again(made.report, self._options)
        if field is not None and field.diameter_deg is not None and has_time:
            plan = self._plan(loaded, psfs, field.diameter_deg)
            made = self._solved(plan, loaded, dark)
        self._last = plan
        if plan.is_to_be_judged(made.report):
            made = replace(made, report=judged(made.report, self._judge(source, dark).report))
        of_field = () if field is None else (field.note(has_time),)
        of_psfs = () if psfs is None else (*psfs.notes, *psfs.damage)
        if loaded.is_encoded or (psfs is not None and psfs.damage):
            made = replace(made, report=without_psf_figures(made.report, "the counts of raw or PSF are damaged"))
        elif field is not None and field.diameter_deg is None:
            made = replace(made, report=without_psf_figures(made.report, NO_DISC))
        of_raw = (*loaded.notes, *head_notes(self._options, loaded))
        notes = (*of_field, *of_raw, *of_psfs, *companion_notes(self._options, plan.calibrations[0]))
        warnings = made.report.warnings
        swapped = () if psfs is None else swap_notes(loaded, psfs)
        if swapped or loaded.notes:  # the reason why the PSF does not match
            warnings = tuple(warning for warning in warnings if warning not in MISMATCHES.values())
        if swapped or loaded.notes or of_psfs:
            warnings = tuple(UNEXPLAINED if words.startswith(UNEXPLAINED) else words for words in warnings)
        report = replace(made.report, warnings=(*warnings, *swapped, *notes))
        picture = made.picture if loaded.bayer is None else bayer.whole_size(made.picture, loaded.shape)
        return replace(made, picture=picture, report=report)

    def _solved(self, plan: "_FrameSolvers", loaded: LoadedRaw, dark: Source | None) -> FileReconstruction:
        """Return picture and report of a raw by the solvers of a plan; FrameError for one that cannot be solved."""
        own = None if dark is None else companion(dark, "the dark frame", loaded)
        pixels, own = without_unknown(loaded.raw.pixels, own)
        try:
            made = plan.solve(replace(loaded, raw=replace(loaded.raw, pixels=pixels)), own)
        except FrameError as error:  # the other remedies are for the operator of a head
            remedy = "Look for saturated or invalid pixels in the frame, its dark frame and its flat frame."
            remedy = ROWS_REMEDY if error.remedy == ROWS_REMEDY else remedy
            raise FrameError(f"{loaded.name}: {error.message}", remedy) from error
        if NO_SIGNAL in made.report.warnings:
            raise FrameError(
                f"{loaded.name} holds no signal above the black level",
                "Give a frame that was taken with light; look whether the dark frame belongs to it.",
            )
        return made

    def evened(self, picture: Image) -> Image:
        """Return the last picture with the `even` correction, if the options have it."""
        if not self._options.even or self._last is None:
            return picture
        calibration = self._last.calibrations[0]
        shape = (picture.shape[0], picture.shape[1])
        if self._last.is_mosaic and calibration.geometry is not None:  # of a plane, which has half the pixels
            geometry = replace(calibration.geometry, pitch_um=calibration.geometry.pitch_um / 2)
            calibration = replace(calibration, geometry=geometry)
        return flat_field_correct(picture, field_mask(calibration, shape), evenness_px(calibration, shape))

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the lit field in the last picture; all of them for a mosaic, or before any picture."""
        if self._last is None or self._last.is_mosaic:
            return slice(None), slice(None)
        return field_box(self._last.calibrations[0], self._last.shape)

    @cached_property
    def _judge(self) -> "FileReconstructor":
        """Reconstruction by the default method, whose residual shows what a closed form cannot tell."""
        options = replace(self._options, method=None, bin=None, rounds=None, settings={}, sweep=None)
        return FileReconstructor(options, self._planner, timed=self._timed)

    def _psfs_for(self, loaded: LoadedRaw) -> LoadedPsfs | None:
        """Return the PSFs for a raw, read at the first raw of its shape; None for an archived calibration."""
        key = (loaded.shape, loaded.channels, loaded.bayer)
        if key not in self._psfs:
            archived = self._options.calibration is not None
            self._psfs[key] = None if archived else load_psfs(self._options, loaded)
        return self._psfs[key]

    def _plan(self, loaded: LoadedRaw, psfs: LoadedPsfs | None, field_deg: float | None) -> "_FrameSolvers":
        """Return the plan for the shape and levels of a raw and its field, and make it the last one to be dropped."""
        raw = loaded.raw
        bad = raw.bad.tobytes() if raw.bad.any() else b""
        levels = (raw.white_dn, raw.shift, raw.stored_bits, loaded.black_dn, loaded.simulated, loaded.light, bad)
        key = (loaded.shape, loaded.channels, loaded.bayer, field_deg, *levels)

        def plan() -> _FrameSolvers:
            calibrations = load_calibrations(replace(self._options, field_deg=field_deg), loaded, psfs)
            is_mosaic = loaded.bayer is not None
            of_frame = loaded.solved_shape, self._planner, is_mosaic, self._timed
            return _FrameSolvers(self._options, calibrations, *of_frame)

        return self._plans.get_or_make(key, plan)


class _FrameSolvers:
    """Solvers for one shape and one set of levels: one for all channels, or one for each; planned for each used PSF."""

    def __init__(
        self,
        options: ReconstructOptions,
        calibrations: tuple[Calibration, ...],
        shape: Shape,
        planner: Planner,
        is_mosaic: bool,
        timed: bool,
    ) -> None:
        self.calibrations, self.is_mosaic = calibrations, is_mosaic
        self._timed = timed
        self._options = options
        self.shape = shape
        self._planner = planner
        self._clock = SystemClock()
        self._solvers: dict[int, tuple[Reconstructor, ...]] = {}
        if options.sweep is not None and len(calibrations[0].psfs) < 2:
            raise SettingError("a sweep compares several PSFs", "Give --psf more than once, or leave --sweep out.")

    def solve(self, loaded: LoadedRaw, dark: Image | None = None) -> FileReconstruction:
        """Return the picture and the report of a raw, on the pixels on which it is solved.

        `dark` is its own dark frame, (rows, cols), or of a mosaic (rows, cols, 3).
        """
        options = self._options
        pixels = loaded.raw.pixels
        begin_s = self._clock.now_s()
        index = self._most_likely_psf(loaded)
        selected_s = self._clock.now_s() - begin_s  # of the budget, unlike the plans
        if index not in self._solvers:
            self._solvers[index] = self._planned(index)
        solvers = self._solvers[index]
        frames = [pixels] if len(solvers) == 1 else [plane(pixels, c) for c in range(3)]
        deadline = None
        if options.budget_s is not None and self._timed:
            deadline = Deadline.after(self._clock, options.budget_s).later(-selected_s)
        made = []
        for c, (solver, frame) in enumerate(zip(solvers, frames, strict=True)):
            shared = None if deadline is None else Deadline.after(self._clock, _share_s(deadline, len(frames) - c))
            own = dark if dark is None or len(solvers) == 1 else plane(dark, c)
            made.append(solver(frame, own, simulated=solver.calibration.simulated, deadline=shared))
        main = made[0 if len(made) == 1 else _brightest(pixels)].report
        picture = made[0].picture if len(made) == 1 else np.stack([channel.picture for channel in made], axis=2)
        report = replace(
            file_report(main, solvers[0], options),
            seconds=summed_seconds(made),
            warnings=(*_united(made), *doubts(main, solvers[0], loaded.notes), *note_on_missing(main)),
            psf_channels=len(made),
            bayer=loaded.bayer,
        )
        return FileReconstruction(picture, report, loaded.simulated or self.calibrations[0].simulated)

    def is_to_be_judged(self, report: Report) -> bool:
        """Return whether a closed form without a deadline doubts the PSF or the field, or its frame is odd."""
        method = METHODS.get(self._options.method or "")
        if method is None or method.rounds or self._options.budget_s is not None or self._options.head is None:
            return False
        return is_doubtful(report, self._options) or any(map(is_doubt, report.warnings))

    def smaller_field(self, report: Report, loaded: LoadedRaw) -> LitField | None:
        """Return the lit disc of a solved raw where it is smaller than the field; SettingError where it is larger."""
        if not is_doubtful(report, self._options):
            return None
        pixels = loaded.raw.pixels
        c = _brightest(pixels) if pixels.ndim == 3 else 0
        calibration = self.calibrations[min(c, len(self.calibrations) - 1)]
        return smaller_field(self._options, calibration, plane(pixels, c), self._planner, report)

    def _planned(self, index: int) -> tuple[Reconstructor, ...]:
        """Return a solver for each calibration; all at the finest bin that one of them needs."""
        options = self._options
        periodic = options.method is not None and find_method(options.method).periodic
        if len(self.calibrations) > 1 and options.bin is None and not periodic:
            finest = min(default_schedule(calibration, self.shape, index)[1].bin for calibration in self.calibrations)
            options = replace(options, bin=finest)
        quick = options.budget_s is not None
        options = options if self._timed else replace(options, budget_s=None)
        return tuple(
            plan_reconstructor(options, calibration, self.shape, self._planner, index, quick=quick)
            for calibration in self.calibrations
        )

    def _most_likely_psf(self, loaded: LoadedRaw) -> int:
        """Return the index of the most likely PSF of a stack, by the brightest channel; draw the sweep plot."""
        pixels = loaded.raw.pixels
        calibration = self.calibrations[0]
        if len(self.calibrations) > 1:
            c = _brightest(pixels)
            pixels = plane(pixels, c)
            calibration = self.calibrations[c]
        index, scores = most_likely_psf(calibration, pixels, self._planner)
        if self._options.sweep is not None:
            _draw_sweep(self._options.sweep, loaded.name, calibration, scores)
        return index


def is_doubt(warning: str) -> bool:
    """Return whether a warning says that PSF and frame do not match, or that a part of the field or all is dark."""
    return warning in MISMATCHES.values() or PARTLY_LIT in warning or LITTLE_LIGHT in warning


def judged(report: FileReport, default: FileReport) -> FileReport:
    """Return the report of a closed form with the doubts that the default method has of the same frame."""
    warnings = [warning for warning in report.warnings if not is_doubt(warning)]
    doubtful = [words for words in default.warnings if is_doubt(words) or words.startswith(UNEXPLAINED)]
    share = default.quality.get("spots")
    if share:
        warnings.append(
            f"Spots on {share:.1%} of the frame are no part of the retina, and '{report.method}' does not leave them "
            "out: use the default method. Clean the sensor and the optics before it."
        )
    unexplained = share or states_misfit(doubtful)
    report = replace(report, warnings=tuple(dict.fromkeys((*warnings, *doubtful))))
    return without_psf_figures(report, "the forward model does not explain the frame") if unexplained else report


def without_psf_figures(report: FileReport, reason: str) -> FileReport:
    """Return the report without refraction, which is refused for a reason, and without figures of the spectrum."""
    refraction = None if report.refraction_dpt is None else report_of(NoRefraction(reason))
    unknown = (*PSF_FIGURES, "through")
    quality = {name: None if name in unknown else figure for name, figure in report.quality.items()}
    return replace(report, refraction_dpt=refraction, refraction_scatter=None, quality=quality)


def file_report(report: Report, solver: Reconstructor, options: ReconstructOptions) -> FileReport:
    """Return the report of a solver with what was set and the size on which it solved the frame."""
    return FileReport(**vars(report), solved=_solved_size(solver, report), given=given_options(options))


def doubts(report: Report, solver: Reconstructor, notes: Collection[str]) -> tuple[str, ...]:
    """Return what to doubt without a known field: a closed form, a residual that neither noise nor `notes` explain.

    With a known field the residual is judged by `quality_warnings`, which allows for stray light.
    """
    if np.isfinite(field_radius_px(solver.calibration)):
        return ()
    found = []
    is_plugin = report.method not in METHODS
    is_closed_form = solver.stages[_place_of(solver, report)].is_closed_form
    if is_closed_form or is_plugin:
        kind = "plug-in" if is_plugin else "closed form"
        found.append(
            f"No field is known, and the {kind} '{report.method}' takes the whole frame as lit. Where only a disc "
            "is lit, give the head (--head), or use the method 'open'."
        )
    residual = report.residual or 0.0
    if residual > MAX_RESIDUAL and not notes and not states_misfit(report.warnings):
        found.append(
            f"The residual is {residual:.1f} times the noise, and about 1 where the picture explains the frame: parts "
            "of it may be false."
        )
    return tuple(found)


def note_on_missing(report: Report) -> tuple[str, ...]:
    """Return a sentence about missing pixels for a method that does not leave them out."""
    method, share = METHODS.get(report.method), report.quality.get("missing") or 0.0
    if method is None or not method.periodic or share <= MAX_FILLED:
        return ()
    filled = f"{share:.1%} of the pixels are missing, and '{report.method}' does not leave them out"
    return (f"{filled}: use the default method.",)


def _share_s(deadline: Deadline, channels_left: int) -> float:
    """Return the seconds for the next channel: an equal share of what is left, and at least a microsecond."""
    return max(deadline.left_s() / channels_left, 1e-6)


def _brightest(pixels: Pixels) -> int:
    return int(np.argmax(pixels.mean(axis=(0, 1), dtype=np.float64)))


def summed_seconds(made: Iterable[Reconstruction]) -> dict[str, float]:
    """Return the durations of each stage, in s, summed over several reconstructions."""
    seconds: dict[str, float] = {}
    for reconstruction in made:
        for stage, duration_s in reconstruction.report.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + duration_s
    return seconds


def _united(made: Iterable[Reconstruction]) -> tuple[str, ...]:
    """Return the warnings of all channels; NO_SIGNAL only if no channel has a signal."""
    reports = [reconstruction.report for reconstruction in made]
    some_lit = any(NO_SIGNAL not in report.warnings for report in reports)
    words = dict.fromkeys(warning for report in reports for warning in report.warnings)
    return tuple(word for word in words if not (some_lit and word == NO_SIGNAL))


def _solved_size(solver: Reconstructor, report: Report) -> Shape:
    """Return (rows, cols) in samples of the frame in the stage that made the picture."""
    return solver.stages[_place_of(solver, report)].grid.window


def _place_of(solver: Reconstructor, report: Report) -> int:
    """Return the index of the stage that made the picture."""
    recipes = [(stage.recipe.method, stage.recipe.bin) for stage in solver.stages]
    return max(k for k, recipe in enumerate(recipes) if recipe == (report.method, report.bin))


def given_options(options: ReconstructOptions) -> dict[str, float | str | dict[str, float]]:
    """Return the options that replaced a choice of the program, by their names."""
    single: dict[str, float | str | None] = {
        "method": options.method,
        "bin": options.bin,
        "rounds": options.rounds,
        "budget_s": options.budget_s,
        "field_deg": options.field_deg,
        "bayer": options.bayer,
        "gamma": options.gamma,
        "refraction": None if options.refraction else "left out",
    }
    given: dict[str, float | str | dict[str, float]] = {
        key: value for key, value in single.items() if value is not None
    }
    return given | ({"settings": dict(options.settings)} if options.settings else {})


def plan_reconstructor(
    options: ReconstructOptions,
    calibration: Calibration,
    shape: Shape,
    planner: Planner,
    index: int,
    *,
    quick: bool = False,
    refract: bool = True,
) -> Reconstructor:
    """Return the reconstructor of the options, planned for a calibration and a frame shape; `index` is the PSF's.

    `quick`: with a quick look before the picture, as with a time budget. `refract`: with the refraction of the eye, if
    the options have it.
    """
    method = None if options.method is None else find_method(options.method)
    recipes = _recipes(options, method, calibration, shape, index)
    if quick and len(recipes) == 1:
        recipes = (default_schedule(calibration, shape, index)[0], *recipes)
    return Reconstructor(
        calibration,
        shape,
        planner,
        SystemClock(),
        recipes,
        index,
        refract=refract and options.refraction,
        consistency=PsfConsistency(calibration, shape, index),
        timed=options.budget_s is not None,
        methods=METHODS if method is None else {**METHODS, method.name: method},
        audience=Audience.FILES,
        field_fixed=options.field_fixed,
    )


def _recipes(
    options: ReconstructOptions, wanted: Method | None, calibration: Calibration, shape: Shape, index: int
) -> tuple[Recipe, ...]:
    """Return the requested method, by default at the bin of the default schedule (on a periodic grid: bin 1).

    With a time budget, the schedule's quick look comes first. SettingError for a bin or rounds that the method or the
    frame does not have.
    """
    quick, full = default_schedule(calibration, shape, index)
    method = METHODS[full.method] if wanted is None else wanted
    n = options.bin or (1 if method.periodic else full.bin)
    most = max(1, min(shape) // MIN_SAMPLES)
    if not 1 <= n <= most:
        raise SettingError(
            f"a bin of {n} leaves {shape[0] // n} x {shape[1] // n} samples of a frame of {shape[0]} x {shape[1]}",
            f"Give --bin from 1 to {most}.",
        )
    if options.rounds is not None and not method.round_pairs:
        raise SettingError(
            f"the method '{method.name}' has a closed form and no rounds",
            "Leave --rounds out, or choose --method variation or open.",
        )
    check_settings(method.name, method.settings, options.settings)
    last = Recipe(method.name, n, options.rounds, tuple(options.settings.items()))
    return (last,) if options.budget_s is None else (quick, last)


def refuse_invalid(options: ReconstructOptions) -> None:
    """Raise SettingError for options that are out of range or contradict each other, before any computation."""
    if options.gamma is not None and not MIN_GAMMA <= options.gamma <= MAX_GAMMA:
        raise SettingError(
            f"a gamma of {options.gamma:g} is that of no picture",
            f"Give --gamma between {MIN_GAMMA:g} and {MAX_GAMMA:g}, as a rule 2.2.",
        )
    if (options.calibration is None) == (not options.psfs):
        raise SettingError("a picture needs either PSFs or a calibration", "Give --psf FILE or --calibration DIR[:ID].")
    refuse_invalid_settings(options)


def refuse_invalid_settings(options: ReconstructOptions) -> None:
    """Raise SettingError for a method, its settings, a time budget, a bin or rounds out of range."""
    if options.method is not None:
        method = find_method(options.method)  # raises SettingError for an unknown or a wrong one
        check_settings(method.name, method.settings, options.settings)
    if options.budget_s is not None:
        Deadline.after(SystemClock(), options.budget_s)  # raises SettingError for an invalid time
    if options.bin is not None and options.bin < 1:
        raise SettingError(f"a bin of {options.bin} holds no pixel", "Give --bin from 1: it is pixels per sample.")
    if options.rounds is not None and not 1 <= options.rounds <= MAX_ROUNDS:
        raise SettingError(f"{options.rounds} rounds cannot be run", f"Give --rounds from 1 to {MAX_ROUNDS}.")


def refuse_outputs(output: OutputFiles, inputs: Iterable[Source], options: ReconstructOptions) -> None:
    """Raise SettingError for an output that cannot be written, is of no known kind, or would replace an input.

    `inputs`: raws, and other inputs that the options do not name.
    """
    if output.picture is not None:
        refuse_output(output.picture)
    read = (*inputs, *options.psfs, options.dark, options.flat, options.head)
    refuse_overwriting((output.picture, output.report, options.sweep), read)


def refuse_overwriting(outputs: Iterable[Path | None], inputs: Iterable[object]) -> None:
    """Raise SettingError for an output that cannot be written or is an input; what is no path is skipped."""
    read = {path.resolve() for path in inputs if isinstance(path, Path)}
    for path in outputs:
        if path is None:
            continue
        require_writable(path)
        if path.resolve() in read:
            raise SettingError(f"{path} is an input and would be overwritten", "Choose another name for the result.")


def refuse_output(path: Path) -> None:
    """Raise SettingError for the path of a picture of no known kind, or that cannot be written."""
    if path.suffix.lower() not in ENDINGS:
        raise SettingError(f"{path}: a picture is written as .npy, .tiff or .png", "Choose one of these.")
    require_writable(path)


def parse_settings(words: Iterable[str]) -> Settings:
    """Return the settings in words such as `tau=0.1`; SettingError for another form, or a value that is no number."""
    settings = {}
    for word in words:
        name, equals, text = word.partition("=")
        try:
            value = float(text)
        except ValueError as error:
            raise SettingError(
                f"'{word}' sets nothing", "Give --set KEY=VALUE with a number, as in tau=0.1."
            ) from error
        if not equals or not name or not np.isfinite(value):
            raise SettingError(f"'{word}' sets nothing", "Give --set KEY=VALUE with a number, as in tau=0.1.")
        settings[name.strip()] = value
    return settings


def parse_bayer(word: str | None) -> BayerOption | None:
    """Return a colour filter pattern or "none", in letters of any case; SettingError lists the names."""
    names = get_args(BayerOption)
    if word is not None and word.lower() not in names:
        raise SettingError(f"'{word}' is no colour filter pattern", f"Choose one of: {', '.join(names)}.")
    return None if word is None else cast(BayerOption, word.lower())


def _draw_sweep(place: Path, raw_name: str, calibration: Calibration, scores: list[float]) -> None:
    names = [Path(psf.name).stem for psf in calibration.psfs]
    drawn = sweep_plot.draw_sweep(Path(raw_name).name, names, scores)
    write_or_raise(place, lambda: place.write_text(drawn, encoding="utf-8"))


def require_writable(path: Path) -> None:
    """Raise SettingError if the path is a folder, or if its parent folder does not exist or cannot be written."""
    if path.is_dir() or not path.parent.is_dir():
        what = "is a folder" if path.is_dir() else "is in a folder that does not exist"
        raise SettingError(f"{path} {what}", "Give the name of a file in a folder that exists.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise SettingError(f"{path} may not be written by this user", "Choose a folder of your own.")


def write_or_raise(path: Path, write: Callable[[], object]) -> None:
    """Call `write`; raise StoreError, or StoreFull for a full disk, if an OSError occurs."""
    try:
        write()
    except OSError as error:
        full = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else StoreError
        raise full(f"{path} cannot be written: {error.strerror or error}", "Choose another folder.") from error


def field_mask(calibration: Calibration, shape: Shape) -> Image:
    """Return the illuminated disc on the sensor, float32 of `shape`, 0 to 1; all 1 if the field is unknown."""
    return disc(shape, ((shape[0] - 1) / 2, (shape[1] - 1) / 2), field_radius_px(calibration))


def evenness_px(calibration: Calibration, shape: Shape) -> float:
    """Return the blur sigma of `even` in px: 4 degrees with a known geometry, else an eighth of the shorter side."""
    return 4 * calibration.geometry.px_per_deg if calibration.geometry else min(shape) / 8


def write_picture(path: Path, picture: Image, simulated: bool, *, is_joined: bool = False) -> None:
    """Write a linear picture by the ending of its path; StoreError, or StoreFull for a full disk.

    `is_joined`: it was joined from several colours of light, and is rendered as the instrument does for eyes.
    """
    if path.suffix.lower() == ".png":
        shown, window = (render_colour(picture), DISPLAY) if is_joined else (picture, None)
        write_or_raise(path, lambda: path.write_bytes(to_png(shown, simulated, window=window)))
    else:
        write_or_raise(path, lambda: write_linear(path, picture, simulated))
