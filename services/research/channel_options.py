"""Options of `diffuscope reconstruct` that take a channel: `--channel NAME RAW PSF`, and `--dark NAME=FILE`.

With `--calibration` it is `--channel NAME RAW`.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer.core import TyperCommand

from device.errors import SettingError
from device.recon.colour import CHANNELS

if TYPE_CHECKING:
    from services.research.reconstruct_burst import ChannelSource

SEPARATOR = "\0"  # no path holds it
CHANNEL_REMEDY = "Give --channel NAME RAW PSF, as in --channel green raw.npy psf.npy."


class ReconstructCommand(TyperCommand):
    """Command with the repeatable option `--channel NAME RAW [PSF]`: typer declares no lists of several values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the values of each `--channel` to one, then parse as every command does."""
        joined = _joined(args)
        refuse_stray(joined, {name for parameter in self.params if _takes_value(parameter) for name in parameter.opts})
        return super().parse_args(ctx, joined)


def _takes_value(option: Any) -> bool:
    return option.param_type_name == "option" and not option.is_flag


def refuse_stray(words: Sequence[str], with_value: Collection[str]) -> None:
    """Raise SettingError for a file after the value of --psf, --dark or --flat, if a raw stands before them.

    A shell writes `raw.tiff --psf psf*.tiff` out as several files, and all but the first would be frames of a burst.
    `with_value`: the options that take a value.
    """
    rest = iter(words)
    option = ""
    value = ""
    raw_given = False
    for word in rest:
        name, equals, given = word.partition("=")
        if name in with_value:
            option = name
            value = given if equals else next(rest, "")
        elif word.startswith("-"):
            option = ""
        elif option in ("--psf", "--dark", "--flat") and raw_given:
            remedy = "A stack of PSFs is --psf A --psf B, or --psf FOLDER."
            raise SettingError(
                f"{word} stands after {option} {value} and would be one more frame of a burst",
                f"Give all raws first. {remedy if option == '--psf' else f'One file belongs to {option}.'}",
            )
        else:
            option = ""
            raw_given = True


def _joined(args: Sequence[str]) -> list[str]:
    stored = any(word.partition("=")[0] == "--calibration" for word in args)
    words = iter(args)
    joined = []
    count = 2 if stored else 3
    for word in words:
        joined.append(word)
        if word == "--channel":
            joined.append(SEPARATOR.join(islice(words, count)))
    return joined


def parse_channels(words: Sequence[str], stored: bool) -> "list[ChannelSource]":
    """Return the values of `--channel`, in their order; SettingError for an unknown name or too few values.

    `stored`: the PSFs are those of a stored calibration, and a channel has a name and a raw.
    """
    from services.research.reconstruct_burst import ChannelSource  # deferred: few commands have channels

    found = []
    for word in words:
        values = word.split(SEPARATOR)
        if len(values) < (2 if stored else 3):
            raise SettingError("a channel has a name, a raw and a PSF", CHANNEL_REMEDY)
        name, raw, *psf = values
        if name not in CHANNELS:
            raise SettingError(f"'{name}' is no channel", f"Choose from {', '.join(CHANNELS)}.")
        found.append(ChannelSource(name, Path(raw), Path(psf[0]) if psf else None))
    return found


def parse_darks(words: Sequence[str]) -> tuple[Path | None, dict[str, Path]]:
    """Return the dark frame of all frames, and those of single channels (`NAME=FILE`), by channel.

    SettingError for two dark frames of the same frames.
    """
    common: Path | None = None
    single: dict[str, Path] = {}
    for word in words:
        name, equals, file = word.partition("=")
        if equals and name in CHANNELS:
            if name in single:
                raise SettingError(f"two dark frames are given for {name}", "Give one.")
            single[name] = Path(file)
        elif common is not None:
            raise SettingError("two dark frames are given", "Give one, or --dark NAME=FILE for a channel.")
        else:
            common = Path(word)
    return common, single


def refuse_mixed(
    raws: Sequence[Path], channels: "Sequence[ChannelSource]", darks: Mapping[str, Path], each: bool
) -> None:
    """Raise SettingError for raws together with channels, for neither, or for channels with --each."""
    if channels and (raws or each):
        raise SettingError("channels cannot be mixed with other raws or --each", "Give every raw with --channel.")
    if not channels and not raws:
        raise SettingError("no raw is given", "Give a raw frame, or --channel NAME RAW PSF.")
    if darks and not channels:
        raise SettingError("a dark frame is given for a channel, and no channel", "Give --dark FILE without a name.")
