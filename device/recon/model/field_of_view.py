"""Field of view: radius and bounding box of the lit field on the sensor, in pixels."""

from device.recon.model.grid import Grid, Pair
from device.values import Calibration


def field_box(calibration: Calibration, shape: Pair) -> tuple[slice, slice]:
    """Return the row and column slices of the sensor around the illuminated disc; the whole sensor if unknown."""
    return Grid.periodic(shape, 1, field_radius_px(calibration)).shown


def field_radius_px(calibration: Calibration) -> float:
    """Return the radius of the illuminated disc in sensor pixels; infinite if field or geometry are unknown."""
    if calibration.field_deg is None or calibration.geometry is None:
        return float("inf")
    return calibration.field_deg * calibration.geometry.px_per_deg / 2
