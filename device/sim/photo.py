"""Photograph of a retina as the object of a scene."""

from pathlib import Path

import numpy as np
from PIL import Image as Pictures
from PIL import UnidentifiedImageError

from device.errors import SpecError
from device.sim.fundus import Fundus, field_mask
from device.values import Colour, Image


def photograph(path: Path, shape: tuple[int, int], px_per_deg: float, field_deg: float) -> Fundus:
    """Return the central square of a photograph, scaled to the field's diameter and cropped by the round field.

    Reflectances are float32 (rows, cols) per colour, 0 to 1: the pixel values, taken as linear because the tone curve
    of a photograph is unknown. Vessels and landmarks are None. SpecError if the file is missing or no picture.
    """
    try:
        with Pictures.open(path) as picture:
            rgb = picture.convert("RGB")
    except (OSError, UnidentifiedImageError) as error:
        raise SpecError(
            f"the scene's image {path} cannot be read: {error}", "Give the path of a photograph."
        ) from error
    side = min(rgb.size)
    left, top = (rgb.width - side) // 2, (rgb.height - side) // 2
    wide = max(1, round(px_per_deg * field_deg))
    square = rgb.resize((wide, wide), Pictures.Resampling.LANCZOS, (left, top, left + side, top + side), 3.0)
    pixels = np.asarray(square, np.float32) / np.float32(255)
    field = field_mask(shape, px_per_deg * field_deg / 2)
    names: tuple[Colour, ...] = ("red", "green", "blue")
    planes = {name: np.where(field, _centred(pixels[..., i], shape), np.float32(0)) for i, name in enumerate(names)}
    return Fundus(planes, field)


def _centred(plane: Image, shape: tuple[int, int]) -> Image:
    """Return the plane centred in a float32 array of zeros of `shape`, which must be at least as large."""
    out = np.zeros(shape, np.float32)
    top, left = shape[0] // 2 - plane.shape[0] // 2, shape[1] // 2 - plane.shape[1] // 2
    out[top : top + plane.shape[0], left : left + plane.shape[1]] = plane
    return out
