"""Which LEDs of a board make a ring around the light path: paper, section "Illumination"."""

import numpy as np
from numpy.typing import NDArray

from device.errors import SpecError

FEWEST = 4  # fewer points around the pupil leave most of it unlit


def radii_mm(pitch_mm: float, centre: tuple[float, float], rows: int, cols: int) -> NDArray[np.float64]:
    """How far each LED is from the axis, by its number: row-major, 0 at the bottom left, (rows * cols,).

    `centre` is where the axis meets the board, (row, col) in LEDs from LED 0.
    """
    row, col = np.indices((rows, cols)).reshape(2, -1)
    return np.asarray(pitch_mm * np.hypot(row - centre[0], col - centre[1]))


def ring(
    diameter_mm: float, tolerance_mm: float, pitch_mm: float, centre: tuple[float, float], rows: int, cols: int
) -> tuple[int, ...]:
    """The LEDs whose circle is within `tolerance_mm` of `diameter_mm`; SpecError names the rings that there are."""
    across_mm = 2 * radii_mm(pitch_mm, centre, rows, cols)
    chosen = np.flatnonzero(np.abs(across_mm - diameter_mm) <= tolerance_mm + 1e-9)
    if len(chosen) < FEWEST:
        there = ", ".join(f"{mm:g}" for mm in rings_mm(pitch_mm, centre, rows, cols))
        raise SpecError(
            f"{len(chosen)} LEDs stand on a ring of {diameter_mm:g} mm (within {tolerance_mm:g} mm)",
            f"This board has rings of {there} mm.",
        )
    return tuple(int(led) for led in chosen)


def rings_mm(pitch_mm: float, centre: tuple[float, float], rows: int, cols: int) -> tuple[float, ...]:
    """The diameters on which at least four LEDs stand, to a hundredth of a millimetre, smallest first."""
    across_mm, counts = np.unique(np.round(2 * radii_mm(pitch_mm, centre, rows, cols), 2), return_counts=True)
    return tuple(float(mm) for mm in across_mm[(counts >= FEWEST) & (across_mm > 0)])


def ring_for_pupil_mm(
    pupil_mm: float,
    magnification: float,
    led_mm: float,
    pitch_mm: float,
    centre: tuple[float, float],
    rows: int,
    cols: int,
) -> float:
    """The diameter on the board of the widest ring that passes a pupil whole, as the relay images it there.

    `magnification` is from the board to the pupil; `led_mm` is how wide one LED is, which must pass too.
    """
    fitting = [mm for mm in rings_mm(pitch_mm, centre, rows, cols) if (mm + led_mm) * magnification <= pupil_mm]
    if not fitting:
        raise SpecError(
            f"no ring of this board passes a pupil of {pupil_mm:g} mm", "Dilate the pupil, or change the relay."
        )
    return fitting[-1]
