"""Photograph of a retina as the object of a scene."""

from pathlib import Path

import numpy as np
from PIL import Image as Pictures
from PIL import UnidentifiedImageError

from device.errors import SpecError
from device.sim.fundus import Fundus, field_mask
from device.values import Colour, Image


def photograph(
    path: Path, shape: tuple[int, int], px_per_deg: float, field_deg: float, width_deg: float | None = None
) -> Fundus:
    """Return the central square of a photograph, scaled to the field's diameter and cropped by the round field.

    With `width_deg` the whole photograph keeps its shape and is that wide; what lies beyond `shape` is left out.
    Reflectances are float32 (rows, cols) per colour, 0 to 1: the pixel values, taken as linear because the tone curve
    of a photograph is unknown. Vessels and landmarks are None. SpecError if the file is missing or no picture.
    """
    try:
        with Pictures.open(path) as picture:
            rgb = _eight_bits(picture).convert("RGB")
    except (OSError, UnidentifiedImageError, Pictures.DecompressionBombError) as error:
        raise SpecError(
            f"the scene's image {path} cannot be read: {error}", "Give the path of a photograph."
        ) from error
    side = min(rgb.size)
    left = (rgb.width - side) // 2
    top = (rgb.height - side) // 2
    box = (left, top, left + side, top + side)
    wide_deg = field_deg
    tall_deg = field_deg
    if width_deg is not None:
        box = (0, 0, *rgb.size)
        wide_deg = width_deg
        tall_deg = width_deg * rgb.height / rgb.width
    size = max(1, round(px_per_deg * wide_deg)), max(1, round(px_per_deg * tall_deg))
    scaled = rgb.resize(size, Pictures.Resampling.LANCZOS, box, 3.0)
    pixels = np.asarray(scaled, np.float32) / np.float32(255)
    field = field_mask(shape, px_per_deg * field_deg / 2)
    names: tuple[Colour, ...] = ("red", "green", "blue")
    planes = {name: np.where(field, _centred(pixels[..., i], shape), np.float32(0)) for i, name in enumerate(names)}
    return Fundus(planes, field)


def _eight_bits(picture: Pictures.Image) -> Pictures.Image:
    """Return a grey picture of 16 or 32 bits scaled to 8 bits; others unchanged, because their depth is 8 bits or 1.

    Whole numbers are shares of 65535, floating-point ones of their largest value, so that a dark picture stays dark.
    """
    if not picture.mode.startswith(("I", "F")):
        return picture
    values = np.nan_to_num(np.asarray(picture, np.float64), posinf=0.0, neginf=0.0)
    whole = 65535.0 if picture.mode.startswith("I") else max(float(values.max()), 1e-30)
    return Pictures.fromarray((255 * np.clip(values / whole, 0, 1)).round().astype(np.uint8))


def _centred(plane: Image, shape: tuple[int, int]) -> Image:
    """Return the plane centred in a float32 array of zeros of `shape`; what lies beyond is left out."""
    out = np.zeros(shape, np.float32)
    first = [n // 2 - have // 2 for n, have in zip(shape, plane.shape, strict=True)]
    here = tuple(slice(max(a, 0), min(a + have, n)) for a, have, n in zip(first, plane.shape, shape, strict=True))
    there = tuple(slice(part.start - a, part.stop - a) for part, a in zip(here, first, strict=True))
    out[here] = plane[there]
    return out
