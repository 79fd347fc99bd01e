"""Rendering of a picture in colour for a display: the lightness of the green picture, the hue of all colours.

The hue itself comes from `device/recon/white_balance.py`.

Blood absorbs green light and hardly any red, so that haemorrhages and vessels stand in green. With the hue of a retina
most of the light of a display is red, and in one window for all channels they are faint and red is nearly saturated.
Here the luminance of each displayed pixel is in proportion to the picture in green as it is displayed: what is seen in
green has the same contrast in colour. The colours give the chromaticity only.
"""

import numpy as np

from device.values import Image
from services.imaging.picture_files import display_window

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear red, green and blue (IEC 61966-2-1)
BRIGHTEST = 0.9  # of a channel: below the top of the display, where a hue would be cut
_HIGH = 99.8  # percentile of the lit pixels, as that of the window: the brightest ones lose saturation instead


def render_colour(picture: Image) -> Image:
    """Return the linear light of the display, 0 to BRIGHTEST, for a linear picture (rows, cols, 3); same shape.

    Show it in the window `picture_files.DISPLAY`. The luminance of a pixel is that of its green in the window of a
    picture in green, times one factor for all pixels, the largest at which the hues of the picture fit; the few pixels
    that do not fit then are less saturated, at the same luminance. A pixel without light in any channel is grey.
    """
    low, high = display_window(picture[..., 1])
    luminance = np.clip((picture[..., 1] - np.float32(low)) / np.float32(high - low), 0, 1)
    hue = np.maximum(picture, 0)
    weight = hue @ LUMINANCE
    hue = np.where(weight[..., None] > 0, hue / np.maximum(weight, np.float32(1e-30))[..., None], np.float32(1))
    most = hue.max(axis=2)
    lit = luminance > 0
    if lit.any():
        luminance *= np.float32(BRIGHTEST / max(1.0, float(np.percentile((luminance * most)[lit], _HIGH))))
    fits = (BRIGHTEST - luminance) / np.maximum(luminance * (most - 1), np.float32(1e-30))
    saturation = np.minimum(fits, 1)[..., None]
    return np.asarray(luminance[..., None] * (1 + saturation * (hue - 1)), np.float32)
