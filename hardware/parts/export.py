"""Every printed part as a STEP file, to change it elsewhere, and as an STL file, to slice it."""

from pathlib import Path

from build123d import export_step, export_stl

from hardware.parts.assembly import printed
from hardware.parts.dimensions import Dimensions

FINE_MM, FINE_RAD = 0.01, 0.1  # a circle of 3.2 mm gets 63 corners


def export(d: Dimensions, folder: Path) -> list[Path]:
    """Write two files for each part, standing on the printer's bed; answers what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for part in printed().values():
        shape = part.on_the_bed(d)
        stem = folder / part.name.replace(" ", "-").lower()
        export_step(shape, stem.with_suffix(".step"))
        export_stl(shape, stem.with_suffix(".stl"), tolerance=FINE_MM, angular_tolerance=FINE_RAD)
        written += [stem.with_suffix(".step"), stem.with_suffix(".stl")]
    return written
