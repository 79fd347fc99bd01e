"""`diffuscope reconstruct RAW RAW ...`: one picture of a burst, several frames of one eye in one light."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from device.clock import Deadline, SystemClock
from device.config.image_files import Raw, common_white_dn
from device.errors import FrameError, SettingError
from device.recon.burst import MOST_FRAMES, BurstJoiner
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.estimation.refraction import (
    NoRefraction,
    Refraction,
    RefractionEstimator,
    can_estimate_refraction,
)
from device.recon.estimation.refraction_burst import LEAST_FRAMES
from device.recon.estimation.refraction_notation import report_of, scatter_of
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import plane
from device.values import FrameUse, Report
from services.lab.burst_frames import refuse_psfs, refuse_repeated, refuse_without_first
from services.lab.reconstruct_file import (
    FileReconstruction,
    doubts,
    file_report,
    plan_reconstructor,
    refuse_invalid,
    refuse_overwriting,
    write_picture,
)
from services.lab.reconstruct_inputs import (
    LoadedRaw,
    ReconstructOptions,
    Source,
    load_calibrations,
    load_psfs,
    load_raw,
    refuse_without_signal,
)


def reconstruct_burst(raws: Sequence[Source], options: ReconstructOptions) -> FileReconstruction:
    """Reconstruct one picture from the raws of a burst, on the grid of the first one, and write it.

    `options` holds all other options (`raw` is ignored). The report's `frames` says what became of each raw. FrameError
    for raws of different shapes or levels, with the same pixels, or that look like PSFs, and if the first cannot be
    used; SettingError for invalid options.
    """
    options = replace(options, raw=raws[0])
    solved = solve_burst(load_burst(raws, options), options, Planner(options.plans))
    if options.output is not None:
        write_picture(options.output, solved.picture, solved.simulated)
    return solved


def load_burst(raws: Sequence[Source], options: ReconstructOptions) -> list[LoadedRaw]:
    """Return the raws of a burst as they are stored; SettingError for options that a burst does not have."""
    if not 1 < len(raws) <= MOST_FRAMES:
        raise SettingError(f"{len(raws)} raws are no burst", f"Give 2 to {MOST_FRAMES} raws of one eye in one light.")
    refuse_invalid(options)
    if options.sweep is not None:
        raise SettingError("a sweep is drawn for one raw", "Leave --sweep out, or give one raw.")
    if options.even:
        raise SettingError("the picture of a burst is not evened out", "Leave --even out.")
    refuse_overwriting((options.output, options.report), raws)  # the options name only the first raw
    return [load_raw(raw, options.bayer, checked=False) for raw in raws]


def solve_burst(loaded: Sequence[LoadedRaw], options: ReconstructOptions, planner: Planner) -> FileReconstruction:
    """Return the picture of the loaded raws of a burst; FrameError as of `reconstruct_burst`, or for colour raws."""
    unusable = unusable_raws(loaded)
    if len(unusable) == len(loaded):
        raise FrameError(f"no frame of the burst can be used; the first: {unusable[0]}", "Take the burst again.")
    usable = [one for k, one in enumerate(loaded) if k not in unusable]
    refuse_repeated(usable)
    common, clock = common_raw(usable), SystemClock()
    psfs = None if options.calibration is not None else load_psfs(options, common, per_channel=False)
    calibration = load_calibrations(options, common, psfs)[0]
    refuse_psfs(usable, calibration.psfs)
    index = 0
    if len(calibration.psfs) > 1:
        index, _ = most_likely_psf(calibration, common.raw.pixels, planner)
    joiner = BurstJoiner(calibration, common.solved_shape, planner, clock, index)
    begin_s = clock.now_s()
    joined = joiner([without_bad(one.raw) for one in loaded], unusable)
    join_s = clock.now_s() - begin_s
    refuse_without_first(loaded, joined.frames)
    solver = plan_reconstructor(options, joined.calibration, common.solved_shape, planner, index)
    deadline = None if options.budget_s is None else Deadline.after(clock, max(options.budget_s - join_s, 1e-6))
    made = solver(joined.counts, simulated=any(one.simulated for one in loaded), deadline=deadline)
    notes = tuple(dict.fromkeys(note for one in loaded for note in one.notes))
    report = made.report
    if deadline is None and options.refraction and can_estimate_refraction(calibration):
        estimator = RefractionEstimator(calibration, common.solved_shape, planner, index, options.field_fixed)
        used = [plane(without_bad(loaded[one.index].raw), 0) for one in joined.frames if one.used]
        report = with_scatter(report, estimator, used)
    report = replace(
        file_report(report, solver, options),
        seconds={"join": join_s} | report.seconds, frames=joined.frames,
        warnings=(
            *report.warnings, *doubts(report, solver, notes), *rejections(loaded, joined.frames),
            *(psfs.notes if psfs else ()), *notes,
        ),
    )  # fmt: skip
    return FileReconstruction(made.picture, report, made.simulated or calibration.simulated)


def with_scatter(report: Report, estimator: RefractionEstimator, used: Sequence[Pixels]) -> Report:
    """Return the report of a joined frame with the scatter of the refraction between its frames `used`, in counts.

    The sd of M grows to the scatter, and frames that differ too much refuse the refraction. Less than three frames, or
    a first one that has no refraction by itself, leave the report as it is.
    """
    stated = report.refraction_dpt
    if len(used) < LEAST_FRAMES or stated is None or stated["refused"] is not None:
        return report
    first = estimator.find(used[0], None, estimator.defects(used[0]))
    whole = estimator.add_cylinder(first) if isinstance(first, Refraction) else first
    if isinstance(whole, NoRefraction):
        return report
    joined = estimator.join(whole, used, None)
    if isinstance(joined, NoRefraction):
        return replace(report, refraction_dpt=report_of(joined))
    scatter_dpt = 0.0 if joined.scatter is None else joined.scatter.sd_dpt
    grown = stated | {"sd": max(float(stated["sd"] or 0.0), scatter_dpt)}
    return replace(report, refraction_dpt=grown, refraction_scatter=scatter_of(joined))


def unusable_raws(loaded: Sequence[LoadedRaw]) -> dict[int, str]:
    """Return the reason of each raw that holds no usable signal, by its place in the burst."""
    reasons = {}
    for k, one in enumerate(loaded):
        try:
            refuse_without_signal(one.raw, one.name)
        except FrameError as error:
            reasons[k] = error.message
    return reasons


def common_raw(usable: Sequence[LoadedRaw]) -> LoadedRaw:
    """Return the first usable raw with the levels of all; the bits of a file follow from its brightest pixel.

    FrameError for raws of different shapes, colour patterns or levels, SettingError for colour raws.
    """
    first = usable[0]
    if first.channels != 1:
        raise SettingError(
            "the raws of a burst have one channel, and these have three",
            "Give the raws of each colour with its PSF: --channel NAME RAW PSF.",
        )
    for one in usable[1:]:
        if (one.shape, one.channels) != (first.shape, first.channels):
            raise FrameError(
                f"{one.name} has {_size(one)}, {first.name} {_size(first)}",
                "Give the raws of one burst, in one and the same camera mode.",
            )
        if _storage(one) != _storage(first):
            raise FrameError(
                f"{one.name} is stored in another way than {first.name}: other levels, or other types of numbers",
                "Give the raws of one burst, saved in one format.",
            )
    white_dn = common_white_dn([one.raw for one in usable])
    return replace(first, raw=replace(first.raw, white_dn=white_dn, bad=np.zeros(first.solved_shape, np.bool_)))


def _storage(raw: LoadedRaw) -> tuple[object, ...]:
    return raw.raw.shift, raw.raw.pixels.dtype, raw.black_dn


def without_bad(raw: Raw) -> Pixels:
    """Return the counts, with NaN for bad pixels if there are any."""
    if not raw.bad.any():
        return raw.pixels
    return np.where(raw.bad, np.float32(np.nan), raw.pixels.astype(np.float32))


def rejections(loaded: Sequence[LoadedRaw], frames: Sequence[FrameUse]) -> tuple[str, ...]:
    """Return a note for each raw that is not used."""
    return tuple(
        f"{one.name} was left out: {use.reason}." for one, use in zip(loaded, frames, strict=True) if not use.used
    )


def _size(raw: LoadedRaw) -> str:
    return f"{raw.shape[0]} x {raw.shape[1]} pixels" + (" in three channels" if raw.channels == 3 else "")
