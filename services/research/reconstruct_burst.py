"""`diffuscope reconstruct RAW RAW ...`: one picture of a burst, several frames of one eye in one light."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from device.errors import SettingError
from device.recon.burst import MOST_FRAMES
from device.recon.model.fft_plans import Planner
from device.values import Colour
from services.research.burst_frames import refuse_psfs, refuse_repeated, refuse_without_first
from services.research.reconstruct_capture import CaptureReconstruction, CaptureReconstructor, frames_of_capture
from services.research.reconstruct_file import FileReconstruction, refuse_invalid, refuse_overwriting, write_picture
from services.research.reconstruct_inputs import ReconstructOptions, Source


def reconstruct_burst(raws: Sequence[Source], options: ReconstructOptions) -> FileReconstruction:
    """Reconstruct one picture from the raws of a burst, on the grid of the first one, and write it.

    `options` holds all other options (`raw` is ignored). The report's `frames` says what became of each raw. FrameError
    for raws of different shapes or levels, with the same pixels, or that look like PSFs, and if the first cannot be
    used; SettingError for invalid options.
    """
    solved = solve_burst(raws, replace(options, raw=raws[0]), Planner(options.plans)).made
    if options.output is not None:
        write_picture(options.output, solved.picture, solved.simulated)
    return solved


def solve_burst(
    raws: Sequence[Source],
    options: ReconstructOptions,
    planner: Planner,
    colours: Mapping[Colour, Source] | None = None,
) -> CaptureReconstruction:
    """Return the picture of the raws of a burst, with one frame in each of `colours`, made as that of a press.

    Errors as of `reconstruct_burst`.
    """
    _refuse_invalid(raws, options, 1 if colours else 2)
    capture = CaptureReconstructor(options, planner)
    loaded = capture.load(frames_of_capture(raws, colours or {}))
    refuse_repeated(loaded.usable)
    refuse_psfs(loaded.usable, loaded.psfs)
    refuse_without_first(loaded.lit, loaded.unusable.get(0))
    solved = capture.solve(loaded)
    refuse_without_first(loaded.lit, solved.made.report.frames[0].reason)
    return solved


def _refuse_invalid(raws: Sequence[Source], options: ReconstructOptions, least: int) -> None:
    """Raise SettingError for options that a burst does not have, or an output that is a raw."""
    if not least <= len(raws) <= MOST_FRAMES:
        raise SettingError(f"{len(raws)} raws are no burst", f"Give 2 to {MOST_FRAMES} raws of one eye in one light.")
    refuse_invalid(options)
    if options.sweep is not None:
        raise SettingError("a sweep is drawn for one raw", "Leave --sweep out, or give one raw.")
    if options.even:
        raise SettingError("the picture of a burst is not evened out", "Leave --even out.")
    refuse_overwriting((options.output, options.report), raws)  # the options name only the first raw
