"""The sensor spacer: its thickness is the distance from diffuser to sensor."""

from build123d import Part

from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.shapes import joined, rod, square

UP = (0.0, 0.0, 1.0)
WINDOW_MM = 34.5  # clears the screws of the retaining ring and what stands on the board


def sensor_spacer(d: Dimensions) -> Part:
    """A frame between cell and camera board; paper under it, 0.1 mm a sheet, trims what a printer misses."""
    z = (d.cell_rear_z_mm, d.board_z_mm)
    half = d.bought.board_holes_mm / 2
    holes = joined(rod(d.fit.m25_mm, z, (i * half, j * half)) for i, j in FOUR)
    return square(d.bought.board_mm - d.fit.slide_mm, z, d.fit.chamfer_mm) - rod(WINDOW_MM, z) - holes
