"""Image surfaces of a thin lens, a check of the ray trace."""


def petzval_mm(focal_length_mm: float = 25.0, index: float = 1.517) -> tuple[float, float]:
    """Return the radii of the sagittal and tangential image surfaces of a thin lens, mm: f/(1 + 1/n), f/(3 + 1/n).

    The stop is at the lens.
    """
    return focal_length_mm / (1 + 1 / index), focal_length_mm / (3 + 1 / index)
