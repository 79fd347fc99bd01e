"""White balance of a colour picture: the light of each colour over that of a white card in the same lamp light.

The level of a solved channel says nothing about its colour: lamp, sensor and diffuser have their own response to each
colour. The card divides them out. Without a card the hue is neutral: the means of red and blue over that of green are
those that a card would give for an average retina. NUMERICS.md 10.4.
"""

from collections.abc import Mapping
from math import nan

import numpy as np

from device.recon.colour import RGB
from device.recon.model.kernels import Pixels
from device.values import Calibration, Colour, Image

# Reflectance of a colour over that of green, mean of nasal fundus and perifovea (Delori and Pflibsen, OPTICS.md 4.1).
OVER_GREEN: dict[Colour, float] = {"red": 3.61, "green": 1.0, "blue": 0.627}


def light_dn_per_s(counts: Pixels, dark: Pixels | None, calibration: Calibration, full_drive_s: float) -> float:
    """Return the mean light of a frame over the sensor at full drive, DN per second, without bad pixels.

    `counts` (rows, cols); `dark`: dark frame of the same exposure, None: that of the calibration, else its black level.
    `full_drive_s` is the exposure in seconds times the level of the lamp. NaN if the dark frame in use or the map of
    bad pixels has another shape: no solver takes such a frame either.
    """
    level: Pixels | Image | float = calibration.sensor.black_dn
    if dark is not None:
        level = dark
    elif calibration.dark_dn is not None:
        level = calibration.dark_dn
    maps = (level, calibration.bad)
    if any(not isinstance(array, float | int) and array is not None and array.shape != counts.shape for array in maps):
        return nan
    if calibration.bad is None:
        return (_mean(counts) - _mean(level)) / full_drive_s
    good = ~calibration.bad
    return (_mean(counts[good]) - _mean(level if isinstance(level, float | int) else level[good])) / full_drive_s


def white_ratios(calibration: Calibration, lights_dn_per_s: Mapping[Colour, float]) -> dict[Colour, float]:
    """Return each light over that of the white card; only the colours that have both, with a light above 0."""
    white = {} if calibration.white is None else dict(calibration.white.dn_per_s)
    return {colour: light / white[colour] for colour, light in lights_dn_per_s.items() if light > 0 and colour in white}


def balanced(picture: Image, field: Image, ratios: Mapping[Colour, float]) -> Image:
    """Return a picture (rows, cols, 3) whose red and blue have given mean values over the field, relative to green.

    `field` is the lit field, (rows, cols) in 0..1. The wanted ratio of a colour is its value in `ratios` (light over
    that of the white card) over the value of green; it is that of an average retina, OVER_GREEN, if either is missing.
    Green stays as it is, and so does a channel without light; without light in green, red and blue become 0.
    """
    green = ratios.get("green")
    hue = [OVER_GREEN[colour] if not green else _share(colour, ratios, green) for colour in RGB]
    inside = field > 0.5
    means = picture[inside].mean(axis=0, dtype=np.float64)
    wanted = means[1] * np.array(hue)
    return np.asarray(picture * np.where(means > 0, wanted / np.maximum(means, 1e-30), 1), np.float32)


def _share(colour: Colour, ratios: Mapping[Colour, float], green: float) -> float:
    """Return the light of a channel over that of green; amber light stands for red, as in the picture."""
    measured = ratios.get(colour, ratios.get("amber") if colour == "red" else None)
    return OVER_GREEN[colour] if measured is None else measured / green


def _mean(values: Pixels | Image | float) -> float:
    """Return the mean of the values that are not missing (NaN)."""
    if isinstance(values, float | int):
        return float(values)
    if np.issubdtype(values.dtype, np.integer):
        return float(values.mean(dtype=np.float64))
    return float(np.nanmean(values, dtype=np.float64))
