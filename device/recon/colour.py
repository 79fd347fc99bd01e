"""Colour: pictures of one eye in several colours of light, brought to one grid and joined to one picture.

The colours are taken one after the other, and the eye moves in between. Each channel has its own PSF and is solved by
itself; the others are registered to green and moved to its grid. Edges are where green has them, so red and blue are
then filtered with green as the guide. A blue that was not taken can be predicted from red and green: blue at full
drive has 45 times the hazard of green (OPTICS.md 4.4). NUMERICS.md 10.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from device.recon.estimation.registration import Registrar, Registration, Shift
from device.recon.model.resampling import block_mean, moved_back
from device.values import ChannelUse, Colour, Image

CHANNELS: tuple[Colour, ...] = ("red", "green", "blue", "amber")
RGB: tuple[Colour, ...] = ("red", "green", "blue")  # channels of the picture
FLATTEN_PX = 12.0  # colours differ in their shading: less of it is kept than between frames of one colour
BAND_PER_PX = (0.01, 0.12)
GUIDE_PX = 17  # window of the guided filter, and the share of the guide's variance that is noise
GUIDE_EPS = 0.01
GUIDED_SHARE = 0.5  # of the filtered picture; the rest keeps what green does not show
MIN_SD = 10.0  # of the correlation: wrong registrations had 9.2 or less, right ones 10 or more (NUMERICS.md 10.1)
MIN_CERTAIN = 0.5  # of the correlation itself: in a small picture the surface has too few places for MIN_SD

# Blue over its mean as a linear function of red and green over theirs: offset, red, green. Least squares over the sRGB
# values of four photographs, each with the same weight (sources, licences and range: NUMERICS.md 10.3). They are
# applied to linear pictures.
BLUE_FROM_RED_GREEN = (-0.133, 0.274, 0.862)
BLUE_OVER_GREEN = 0.60  # median of mean blue over mean green, sRGB values, 0.42 to 0.72; linear: white_balance
MAX_OF_MEAN = 3.0  # of red and green over their means: the photographs reach 1.3 and 3.2


@dataclass(frozen=True)
class ColourPicture:
    """Linear picture (rows, cols, 3) in red, green and blue on the grid of the reference, and its channels.

    `doubtful` names the channels whose registration is no better than chance; they were not moved.
    """

    picture: Image
    channels: tuple[ChannelUse, ...]
    doubtful: tuple[Colour, ...]


def join_colours(pictures: Mapping[Colour, Image], field: Image, n: int) -> ColourPicture:
    """Join linear pictures (rows, cols) of one eye in several colours to one picture in red, green and blue.

    `field` is the lit field, (rows, cols) in 0..1; `n` the pixels per sample at which the pictures were solved. The
    reference is green, else the first. Amber stands for a missing red. A missing blue is predicted from red and green;
    a missing red repeats the reference, a missing green repeats red. All three count as predicted.
    """
    reference: Colour = "green" if "green" in pictures else next(iter(pictures))
    shifts, doubtful = register_colours(pictures, reference, field, n)
    on_grid = {name: moved_back(picture, np.ones_like(picture), shifts[name])[0] for name, picture in pictures.items()}
    guided = {
        name: picture if name == reference else _with_guide(picture, on_grid[reference], field)
        for name, picture in on_grid.items()
    }
    red = guided.get("red", guided.get("amber", guided[reference]))
    green = guided.get("green", red)
    blue = guided["blue"] if "blue" in guided else predicted_blue(red, green, field)
    missing = [name for name in RGB if name not in pictures and not (name == "red" and "amber" in pictures)]
    uses = [ChannelUse(name, shifts[name]) for name in pictures]
    uses += [ChannelUse(name, None, predicted=True) for name in missing]
    return ColourPicture(np.stack([red, green, blue], axis=2).astype(np.float32), tuple(uses), doubtful)


def register_colours(
    pictures: Mapping[Colour, Image], reference: Colour, field: Image, n: int
) -> tuple[dict[Colour, Shift], tuple[Colour, ...]]:
    """Return the shift of each channel from the reference in pixels, and the channels that match no better than chance.

    The shift is found twice: the second time on the moved picture, windowed on the same part of the retina.
    """
    registrar = Registrar(block_mean(field, n), n, FLATTEN_PX, BAND_PER_PX)
    flats = {name: registrar.flat(block_mean(picture, n)) for name, picture in pictures.items()}
    target = registrar.detail(flats[reference])
    shifts: dict[Colour, Shift] = {}
    doubtful: list[Colour] = []
    for name, flat in flats.items():
        found = Registration((0.0, 0.0), 1.0, 0.0)
        if name != reference:
            found = registrar.register(target, registrar.detail(flat))
        if found.correlation < min(MIN_SD * found.sd, MIN_CERTAIN):
            doubtful.append(name)
            found = Registration((0.0, 0.0), 0.0, 0.0)
        elif name != reference:
            rest = registrar.register(target, registrar.detail(flat, found.shift_px)).shift_px
            found = Registration((found.shift_px[0] + rest[0], found.shift_px[1] + rest[1]), 1.0, 0.0)
        shifts[name] = found.shift_px
    return shifts, tuple(doubtful)


def _with_guide(picture: Image, guide: Image, field: Image) -> Image:
    """Return the mean of a picture and its guided filter, by GUIDED_SHARE (NUMERICS.md 10.2)."""
    share = np.float32(GUIDED_SHARE)
    return share * guided_filter(picture, guide, field) + (1 - share) * picture


def guided_filter(picture: Image, guide: Image, field: Image) -> Image:
    """Return the picture as a local linear function of the guide (He, Sun and Tang, IEEE TPAMI 35, 1397, 2013).

    All (rows, cols); windows are GUIDE_PX wide and see only the field. Outside the field the picture is unchanged.
    """
    inside = (field > 0.5).astype(np.float32)
    weight = np.maximum(ndimage.uniform_filter(inside, GUIDE_PX), 0.05)

    def mean(image: Image) -> Image:
        return np.asarray(ndimage.uniform_filter(image * inside, GUIDE_PX) / weight, np.float32)

    eps = max(GUIDE_EPS * float(guide[inside > 0].var()) if inside.any() else 0.0, 1e-20)  # an even guide has none
    mean_guide = mean(guide)
    mean_picture = mean(picture)
    slope = (mean(guide * picture) - mean_guide * mean_picture) / (mean(guide**2) - mean_guide**2 + eps)
    filtered = mean(slope) * guide + mean(mean_picture - slope * mean_guide)
    return np.where(inside > 0, filtered, picture).astype(np.float32)


def predicted_blue(red: Image, green: Image, field: Image) -> Image:
    """Return a blue channel predicted from red and green (rows, cols), in the units of green.

    It is no measurement: what only blue light shows is missing. Its mean is about BLUE_OVER_GREEN times that of green;
    `white_balance.balanced` sets another mean in the picture of a press.
    """
    inside = field > 0.5
    means = [float(channel[inside].mean()) if inside.any() else float(channel.mean()) for channel in (red, green)]
    r, g = (
        np.clip(channel / max(mean, 1e-30), 0, MAX_OF_MEAN) for channel, mean in zip((red, green), means, strict=True)
    )
    offset, of_red, of_green = BLUE_FROM_RED_GREEN
    blue = offset + of_red * r + of_green * g
    return np.asarray(np.maximum(blue, 0) * BLUE_OVER_GREEN * means[1] * field, np.float32)
