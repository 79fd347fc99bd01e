"""Flat-field correction of a picture after the deconvolution, x / LP(x), as in the paper."""

import numpy as np
from scipy import ndimage

from device.errors import SettingError
from device.values import Image


def flat_field_correct(picture: Image, mask: Image, sigma_px: float) -> Image:
    """Return a picture divided by its own blur inside `mask` (rows, cols), times the mean there; zero outside.

    The blur is a Gaussian of `sigma_px`, normalised by the blurred mask so that the field edge is not darkened. Where
    the blur is below 5 % of its maximum the result is 0, because dividing would amplify noise. Colour is corrected
    channel by channel. SettingError unless `sigma_px` > 0. Paper, sections 3.1 and 3.2.
    """
    if not sigma_px > 0:
        raise SettingError(f"a blur of {sigma_px} pixels evens nothing out")
    if picture.ndim == 3:
        return np.stack([flat_field_correct(picture[..., c], mask, sigma_px) for c in range(picture.shape[2])], axis=-1)
    inside = np.maximum(picture, 0) * mask
    weight = ndimage.gaussian_filter(mask, sigma_px, mode="constant")
    light = ndimage.gaussian_filter(inside, sigma_px, mode="constant") / np.maximum(weight, 1e-6)
    lit = (mask > 0.5) & (light > 0.05 * light.max())
    if not lit.any():
        return np.zeros_like(picture)
    mean = float(picture[lit].mean(dtype=np.float64))
    return np.where(lit, picture * (mean / np.where(lit, light, 1)), 0).astype(np.float32)
