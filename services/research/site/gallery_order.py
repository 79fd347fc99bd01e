"""Order of the gallery: from the first own picture to extensions."""

from pathlib import Path

NAMES = (
    "own_raw_and_psf",
    "calibration",
    "wrong_refraction",
    "cropped_sensor",
    "hard_case",
    "frontier",
    "own_solver",
    "own_effect",
)


def order(file: str) -> int:
    """Return the position of a script in the gallery; ValueError for a script without a place."""
    return NAMES.index(Path(file).stem)
