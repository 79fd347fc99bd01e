"""A photograph of a retina as the object behind the simulated optics."""

from pathlib import Path

import numpy as np
from PIL import Image as Pictures
from PIL import UnidentifiedImageError

from device.errors import SpecError
from device.sim.fundus import Fundus, field_mask
from device.values import Colour, Image


def photograph(path: Path, shape: tuple[int, int], px_per_deg: float, field_deg: float) -> Fundus:
    """Put the central square of a photograph into the field: float32 (rows, cols) per colour, 0 to 1.

    The picture's values are taken as reflectances as they are: a photograph does not say which curve made them.
    Its vessels and landmarks are not known. Raises SpecError if the file is no picture.
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
    """The plane in the middle of `shape`, which must hold it."""
    out = np.zeros(shape, np.float32)
    top, left = shape[0] // 2 - plane.shape[0] // 2, shape[1] // 2 - plane.shape[1] // 2
    out[top : top + plane.shape[0], left : left + plane.shape[1]] = plane
    return out
