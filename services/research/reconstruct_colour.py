"""`diffuscope reconstruct --channel NAME RAW [PSF] ...`: one colour picture of frames in several colours of light."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from device.errors import FrameError, SettingError
from device.recon.colour import CHANNELS, ColourPicture, join_colours
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px, lit_field
from device.recon.model.grid import Grid
from device.values import Colour, FrameUse, Image
from services.research.psf_stack import psf_stack
from services.research.reconstruct_burst import solve_burst
from services.research.reconstruct_file import (
    FileReconstruction,
    FileReconstructor,
    field_mask,
    given_options,
    refuse_output,
    refuse_overwriting,
    summed_seconds,
    write_picture,
)
from services.research.reconstruct_inputs import ReconstructOptions, Source, load_calibration, load_raw, name_of


@dataclass(frozen=True)
class ChannelSource:
    """Raw and PSF of one frame in one colour of light; files or arrays. `psf` None: that of a stored calibration."""

    name: Colour
    raw: Source
    psf: Source | None = None


def reconstruct_colours(
    sources: Sequence[ChannelSource], options: ReconstructOptions, darks: Mapping[str, Source] | None = None
) -> FileReconstruction:
    """Reconstruct one picture (rows, cols, 3) in red, green and blue, and write it.

    A channel that is given more than once is a burst. The picture is on the grid of the first green frame, without
    green of the first frame. `options` holds all other options (`raw` and `psfs` are ignored), `darks` the dark frames
    of single channels. SettingError for options that do not fit, FrameError for frames of different shapes.
    """
    channels, darks = _by_name(sources), darks or {}
    if options.calibration is not None:
        return _press(channels, options, darks)
    _refuse_invalid(channels, options, darks)
    planner = Planner(options.plans)
    share_s = None if options.budget_s is None else options.budget_s / len(channels)
    made = {
        name: _channel(given, replace(options, dark=darks.get(name, options.dark), budget_s=share_s), planner)
        for name, given in channels.items()
    }
    shapes = {one.picture.shape for one in made.values()}
    if len(shapes) > 1:
        listed = ", ".join(f"{name} {one.picture.shape[0]} x {one.picture.shape[1]}" for name, one in made.items())
        raise FrameError(f"the channels have different sizes: {listed} pixels", "Give frames of one camera mode.")
    return _joined(sources, channels, made, options)


def _press(
    channels: Mapping[Colour, list[ChannelSource]], options: ReconstructOptions, darks: Mapping[str, Source]
) -> FileReconstruction:
    """Reconstruct the frames of a press with a stored calibration, write its colour picture and return it.

    As the instrument does: a burst in green light, and one frame in each other colour. The picture has the size of the
    raws and is 0 outside the lit field.
    """
    raws = [one.raw for one in channels.get("green", ())]
    others: dict[Colour, Source] = {name: given[0].raw for name, given in channels.items() if name != "green"}
    if not raws or not others or len(raws) + len(others) != sum(map(len, channels.values())):
        raise SettingError(
            "with a calibration a colour picture needs frames in green light and one in each other colour",
            "Give --channel green RAW, and --channel NAME RAW once for each other colour.",
        )
    if darks or any(one.psf is not None for given in channels.values() for one in given):
        raise SettingError(
            "with a calibration a channel has no PSF and no dark frame of its own",
            "Give --channel NAME RAW, and --dark FILE.",
        )
    refuse_overwriting((options.output, options.report), [*raws, *others.values()])
    solved = solve_burst(raws, replace(options, raw=raws[0]), Planner(options.plans), others)
    made = solved.made
    if solved.colour is None:
        reasons = "; ".join(f"{one.name}: {one.reason}" for one in made.report.channels if one.reason)
        raise FrameError(f"no other colour can be joined to green: {reasons}", "Look at these frames.")
    picture = np.zeros((*made.picture.shape, 3), np.float32)
    picture[solved.box] = solved.colour
    if options.output is not None:
        write_picture(options.output, picture, made.simulated, is_joined=True)
    return replace(made, picture=picture)


def _refuse_invalid(
    channels: Mapping[Colour, list[ChannelSource]], options: ReconstructOptions, darks: Mapping[str, Source]
) -> None:
    """Raise SettingError for options that a colour picture does not have, or an output that is an input."""
    given = [source for one in channels.values() for source in one]
    if options.psfs or options.bayer is not None or any(one.psf is None for one in given):
        raise SettingError(
            "each channel has a PSF of its own", "Give --channel NAME RAW PSF, without --psf and --bayer."
        )
    if options.even or options.sweep is not None:
        raise SettingError("a colour picture is not evened out, and has no sweep", "Leave --even and --sweep out.")
    for name in darks:
        if name not in channels:
            raise SettingError(f"a dark frame is given for {name}, which is no channel", "Give the channel, too.")
    if options.output is not None:
        refuse_output(options.output)
    inputs = [*(one.raw for one in given), *(one.psf for one in given), *darks.values()]
    refuse_overwriting((options.output, options.report), [*inputs, options.dark, options.flat, options.head])


def _by_name(sources: Sequence[ChannelSource]) -> dict[Colour, list[ChannelSource]]:
    """Return the sources of each channel, in the order in which they were given; SettingError for an unknown name."""
    channels: dict[Colour, list[ChannelSource]] = {}
    for one in sources:
        if one.name not in CHANNELS:
            raise SettingError(f"'{one.name}' is no channel", f"Choose from {', '.join(CHANNELS)}.")
        channels.setdefault(one.name, []).append(one)
    if not channels:
        raise SettingError("a colour picture needs a channel", "Give --channel NAME RAW PSF.")
    for name, given in channels.items():
        if any(not _same(one.psf, given[0].psf) for one in given[1:]):
            raise SettingError(f"{name} has several PSFs", "Give every raw of a colour with the PSF of that colour.")
    return channels


def _psfs(source: ChannelSource) -> tuple[Source, ...]:
    return () if source.psf is None else psf_stack([source.psf])


def _same(one: Source | None, other: Source | None) -> bool:
    if one is None or other is None or isinstance(one, Path) or isinstance(other, Path):
        return one is other or (isinstance(one, Path) and isinstance(other, Path) and one.resolve() == other.resolve())
    return np.array_equal(one, other)


def _channel(given: Sequence[ChannelSource], options: ReconstructOptions, planner: Planner) -> FileReconstruction:
    """Reconstruct the frames of one channel: one frame, or a burst."""
    raws = [one.raw for one in given]
    options = replace(options, raw=raws[0], psfs=_psfs(given[0]), output=None, report=None)
    try:
        if len(raws) > 1:
            return solve_burst(raws, options, planner).made
        made = FileReconstructor(options)(raws[0])
    except FrameError as error:
        raise FrameError(f"{given[0].name}: {error.message}", error.remedy) from error
    if made.picture.ndim == 3:
        raise SettingError(
            f"{name_of(raws[0], 'the raw')} has three channels", "Give a raw of one channel for each colour."
        )
    return made


def _joined(
    sources: Sequence[ChannelSource],
    channels: Mapping[Colour, list[ChannelSource]],
    made: Mapping[Colour, FileReconstruction],
    options: ReconstructOptions,
) -> FileReconstruction:
    """Register the channels, join them, write the picture and return it with its report."""
    reference: Colour = "green" if "green" in made else next(iter(made))
    main = made[reference]
    pictures = {name: one.picture for name, one in made.items()}
    lit = _field(channels[reference][0], main.picture, options)
    joined = join_colours(pictures, lit, main.report.bin)
    report = replace(
        main.report,
        seconds=summed_seconds(made.values()),
        channels=joined.channels,
        frames=_frames(channels, made, sources),
        warnings=_warnings(made, joined),
        psf_channels=len(made),
        given=given_options(options),
    )
    solved = FileReconstruction(joined.picture, report, any(one.simulated for one in made.values()))
    if options.output is not None:
        write_picture(options.output, solved.picture, solved.simulated, is_joined=True)
    return solved


def _field(source: ChannelSource, picture: Image, options: ReconstructOptions) -> Image:
    """Return the lit field on the picture's pixels, 0 to 1: of the head, else the lit area of the picture."""
    calibration = load_calibration(replace(options, raw=source.raw, psfs=_psfs(source)), load_raw(source.raw, "none"))
    shape = picture.shape[0], picture.shape[1]
    if np.isfinite(field_radius_px(calibration)):
        return field_mask(calibration, shape)
    return lit_field(picture, Grid.periodic(shape, 1, float("inf")))


def _frames(
    channels: Mapping[Colour, list[ChannelSource]],
    made: Mapping[Colour, FileReconstruction],
    sources: Sequence[ChannelSource],
) -> tuple[FrameUse, ...]:
    """Return what became of every raw, in the order in which they were given."""
    place = {id(one): k for k, one in enumerate(sources)}
    uses = [
        replace(use, index=place[id(source)])
        for name, given in channels.items()
        for source, use in zip(given, made[name].report.frames, strict=True)
    ]
    return tuple(sorted(uses, key=lambda use: use.index))


def _warnings(made: Mapping[Colour, FileReconstruction], joined: ColourPicture) -> tuple[str, ...]:
    """Return the warnings of all channels, what is predicted, and what could not be registered."""
    words = [f"{name}: {warning}" for name, one in made.items() for warning in one.report.warnings]
    predicted = [one.name for one in joined.channels if one.predicted]
    words += [f"{name} is predicted from the other colours, not measured." for name in predicted]
    words += [
        f"{name} could not be registered: no shift matches better than chance. It is shown where it was taken."
        for name in joined.doubtful
    ]
    return tuple(dict.fromkeys(words))
