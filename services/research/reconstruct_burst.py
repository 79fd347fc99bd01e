"""`diffuscope reconstruct RAW RAW ...` and `--channel NAME RAW [PSF] ...`: one picture of several frames of one eye.

Both are made as the picture of a press: a burst in one light, and frames in other colours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from device.errors import FrameError, SettingError
from device.recon.burst import MAX_FRAMES
from device.recon.colour import CHANNELS
from device.values import Colour
from services.research.burst_frames import refuse_psfs, refuse_repeated, refuse_without_first
from services.research.psf_stack import psf_stack
from services.research.reconstruct_capture import (
    CaptureFrames,
    CaptureReconstruction,
    CaptureReconstructor,
    frames_of_capture,
)
from services.research.reconstruct_file import (
    NO_FILES,
    FileReconstruction,
    OutputFiles,
    refuse_outputs,
    write_picture,
)
from services.research.reconstruct_inputs import ReconstructOptions, Source, name_of, stated_light


@dataclass(frozen=True)
class ChannelSource:
    """Raw and PSF of one frame in one colour of light; files or arrays. `psf` None: that of a stored calibration."""

    name: Colour
    raw: Source
    psf: Source | None = None


def reconstruct_burst(
    raws: Sequence[Source], options: ReconstructOptions, output: OutputFiles = NO_FILES
) -> FileReconstruction:
    """Reconstruct one picture from the raws of a burst, on the grid of the first one, and write it.

    The report's `frames` says what became of each raw. FrameError for raws of different shapes or levels, with the same
    pixels, or that look like PSFs, and if the first cannot be used; SettingError for invalid options.
    """
    _refuse_other_pictures(options, raws)
    capture = CaptureReconstructor(options)
    refuse_outputs(output, raws, options)
    solved = _solved(capture, frames_of_capture(raws, {})).made
    if output.picture is not None:
        write_picture(output.picture, solved.picture, solved.simulated)
    return solved


def reconstruct_colours(
    sources: Sequence[ChannelSource],
    options: ReconstructOptions,
    darks: Mapping[str, Source] | None = None,
    output: OutputFiles = NO_FILES,
) -> FileReconstruction:
    """Reconstruct one picture (rows, cols, 3) in red, green and blue, and write it.

    A channel that is given more than once is a burst. The picture is on the grid of the first green frame, without
    green of the first frame; it has the size of the raws and is 0 outside a known field. `options` has no PSFs, `darks`
    holds the dark frames of single channels. The report is that of the reference, with `channels`. SettingError for
    options that do not fit, FrameError as for a burst, and if no other colour can be joined.
    """
    channels = _by_name(sources)
    darks = darks or {}
    _refuse_invalid_channels(channels, options, darks)
    given = [source for channel in channels.values() for source in channel]
    psfs = [source.psf for source in given if source.psf is not None]
    refuse_outputs(output, (*(source.raw for source in given), *psfs, *darks.values()), options)
    reference: Colour = "green" if "green" in channels else next(iter(channels))
    of_colours = {
        name: replace(options, psfs=_psfs(given[0]), dark=darks.get(name, options.dark))
        for name, given in channels.items()
    }
    raws = {name: [source.raw for source in given] for name, given in channels.items()}
    lit = raws.pop(reference)
    own = of_colours.pop(reference)
    capture = CaptureReconstructor(own, of_colours=of_colours if options.calibration is None else None)
    solved = _solved(capture, frames_of_capture(lit, raws, light=reference))
    made = solved.made
    if solved.colour is None:
        reasons = "; ".join(f"{channel.name}: {channel.reason}" for channel in made.report.channels if channel.reason)
        raise FrameError(f"no other colour can be joined to {reference}: {reasons}", "Look at these frames.")
    picture = np.zeros((*made.picture.shape, 3), np.float32)
    picture[solved.box] = solved.colour
    if output.picture is not None:
        write_picture(output.picture, picture, made.simulated)
    return replace(made, picture=picture)


def _solved(capture: CaptureReconstructor, frames: CaptureFrames) -> CaptureReconstruction:
    """Return the picture of frames that a person gave; refuse those that are no frames of one capture."""
    loaded = capture.load(frames)
    for given in (loaded.usable, *loaded.others.values()):
        refuse_repeated(given)
        refuse_psfs(given, loaded.psfs)
    refuse_without_first(loaded.lit, loaded.unusable.get(0))
    solved = capture.solve(loaded)
    refuse_without_first(loaded.lit, solved.made.report.frames[0].reason)
    return solved


def _refuse_other_pictures(options: ReconstructOptions, raws: Sequence[Source]) -> None:
    """Raise SettingError for too many raws, or options that only one raw has."""
    if len(raws) > MAX_FRAMES:
        raise SettingError(f"{len(raws)} raws are no burst", f"Give 2 to {MAX_FRAMES} raws of one eye in one light.")
    if options.sweep is not None or options.even:
        raise SettingError(
            "the picture of several frames is not evened out, and has no sweep", "Leave --even and --sweep out."
        )


def _refuse_invalid_channels(
    channels: Mapping[Colour, list[ChannelSource]], options: ReconstructOptions, darks: Mapping[str, Source]
) -> None:
    """Raise SettingError for options that a colour picture does not have."""
    given = [source for channel in channels.values() for source in channel]
    if options.calibration is not None and (darks or any(source.psf is not None for source in given)):
        raise SettingError(
            "with a calibration a channel has no PSF and no dark frame of its own",
            "Give --channel NAME RAW, and --dark FILE.",
        )
    if options.calibration is None and (options.psfs or options.bayer or any(source.psf is None for source in given)):
        raise SettingError(
            "each channel has a PSF of its own", "Give --channel NAME RAW PSF, without --psf and --bayer."
        )
    for name in darks:
        if name not in channels:
            raise SettingError(f"a dark frame is given for {name}, which is no channel", "Give the channel, too.")
    if len(channels) < 2:
        raise SettingError(
            "a colour picture needs frames in two colours of light", "Give --channel again for another colour."
        )
    for source in given:
        if (light := stated_light(source.raw)) not in (None, source.name):
            raise SettingError(
                f"{name_of(source.raw, 'the raw')} was taken in {light} light, and is given as {source.name}",
                f"Give it as --channel {light}.",
            )
    _refuse_other_pictures(options, [source.raw for source in given])


def _by_name(sources: Sequence[ChannelSource]) -> dict[Colour, list[ChannelSource]]:
    """Return the sources of each channel, in the order in which they were given; SettingError for an unknown name."""
    channels: dict[Colour, list[ChannelSource]] = {}
    for source in sources:
        if source.name not in CHANNELS:
            raise SettingError(f"'{source.name}' is no channel", f"Choose from {', '.join(CHANNELS)}.")
        channels.setdefault(source.name, []).append(source)
    if not channels:
        raise SettingError("a colour picture needs a channel", "Give --channel NAME RAW PSF.")
    for name, given in channels.items():
        if any(not _same(other.psf, given[0].psf) for other in given[1:]):
            raise SettingError(f"{name} has several PSFs", "Give every raw of a colour with the PSF of that colour.")
    return channels


def _psfs(source: ChannelSource) -> tuple[Source, ...]:
    return () if source.psf is None else psf_stack([source.psf])


def _same(left: Source | None, right: Source | None) -> bool:
    if left is None or right is None or isinstance(left, Path) or isinstance(right, Path):
        return left is right or (
            isinstance(left, Path) and isinstance(right, Path) and left.resolve() == right.resolve()
        )
    return np.array_equal(left, right)
