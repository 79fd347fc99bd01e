"""Even illumination after the fact: the paper's flat-field post-correction, x / LP(x)."""

import numpy as np
from scipy import ndimage

from device.errors import SettingError
from device.values import Image


def even_out(picture: Image, mask: Image, sigma_px: float) -> Image:
    """A picture divided by its own blur inside `mask` (rows, cols), times the mean there; zero outside.

    The blur is a Gaussian of `sigma_px`, normalised by the blurred mask so that the field's rim stays bright. Where it
    is below 5 % of its largest value there is no light to be evened, and the picture is left dark: dividing by it would
    turn noise into detail. Colour is evened channel by channel. Paper, sections 3.1 and 3.2.
    """
    if not sigma_px > 0:
        raise SettingError(f"a blur of {sigma_px} pixels evens nothing out")
    if picture.ndim == 3:
        return np.stack([even_out(picture[..., c], mask, sigma_px) for c in range(picture.shape[2])], axis=-1)
    inside = np.maximum(picture, 0) * mask
    weight = ndimage.gaussian_filter(mask, sigma_px, mode="constant")
    light = ndimage.gaussian_filter(inside, sigma_px, mode="constant") / np.maximum(weight, 1e-6)
    lit = (mask > 0.5) & (light > 0.05 * light.max())
    if not lit.any():
        return np.zeros_like(picture)
    mean = float(picture[lit].mean(dtype=np.float64))
    return np.where(lit, picture * (mean / np.where(lit, light, 1)), 0).astype(np.float32)
