"""The plate of lenslets of a head, as a solid and as a height map; `hardware/lenslets.md`.

x points to the right and y up as seen from the lenses' side, the eye's: `right_um` and `down_um` of the layout, which
are as the sensor sees them, are -x and -y. z is the height above the flat face; the eye is above. All lengths in mm.
"""

from dataclasses import dataclass
from functools import cached_property, reduce
from math import ceil, sqrt
from pathlib import Path

import numpy as np
from build123d import Part, Pos, Solid, export_step
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from device.config.element import iris_places_um
from device.config.head_file import load_head
from device.errors import SpecError
from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import rod

HEAD = Path(__file__).parents[1] / "heads" / "imx296_lenslets.toml"
STEP_MM = 0.002  # of the height map: its image has this width a pixel
COUNT_MM = 1e-6  # height of one count
DATUM_MM = 0.001  # to which the depth of the dents is rounded up

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LensPlate:
    """Equal spherical caps on a flat rim: a cast of the dents of one ball, pressed to one depth.

    `layout` is the name of the file of vertices `centres_mm`, (lenses, 2); `focal_mm` in air, for `index`;
    `distance_mm` from the vertices to the sensor, in air; `play_mm` is how far the iris may be off its axis.
    """

    layout: str
    centres_mm: Floats
    focal_mm: float
    index: float
    distance_mm: float
    thick_mm: float
    wide_mm: float
    iris_mm: float
    play_mm: float

    @property
    def radius_mm(self) -> float:
        """Radius of the lenses' surfaces: (n - 1) f."""
        return (self.index - 1) * self.focal_mm

    @cached_property
    def vertex_mm(self) -> float:
        """Height of the vertices above the rim: such caps leave no gap in an iris off its axis by the play."""
        places_um, step_um = iris_places_um(1000 * (self.iris_mm + 2 * self.play_mm))
        farthest = self._off_mm(places_um / 1000).max() + step_um / 1000  # of all places, these and those in between
        return DATUM_MM * ceil(float(self._sag_mm(farthest)) / DATUM_MM)

    @property
    def cap_mm(self) -> float:
        """Radius of a cap on the rim."""
        return sqrt(self.vertex_mm * (2 * self.radius_mm - self.vertex_mm))

    @property
    def half_mm(self) -> float:
        """Distance from the axis, along x or y, beyond which there is only the rim."""
        return float(np.abs(self.centres_mm).max()) + self.cap_mm

    def height_mm(self, places_mm: Floats) -> Floats:
        """Return the height above the rim at places (places, 2), (places,)."""
        return np.asarray(self.vertex_mm - self._sag_mm(np.minimum(self._off_mm(places_mm), self.cap_mm)))

    def solid(self) -> Part:
        """Return the plate, its flat face on z = 0."""
        rim = self.thick_mm - self.vertex_mm
        ball = Part() + Solid.make_sphere(self.radius_mm, angle1=-90, angle2=90, angle3=360)
        cap = Pos(0, 0, self.thick_mm - self.radius_mm) * ball & rod(3 * self.cap_mm, (rim / 2, 2 * self.thick_mm))
        whole = rod(self.wide_mm, (0, rim))
        for x, y in self.centres_mm:
            whole += Pos(float(x), float(y), 0) * cap
        return whole

    def _off_mm(self, places_mm: Floats) -> Floats:
        """Return the distance of each place from the nearest vertex, (places,)."""
        squares = (((places_mm - centre) ** 2).sum(axis=1) for centre in self.centres_mm)
        return np.asarray(np.sqrt(reduce(np.minimum, squares)))

    def _sag_mm(self, off_mm: Floats | float) -> Floats:
        return np.asarray(self.radius_mm - np.sqrt(self.radius_mm**2 - np.square(off_mm)))


def lens_plate(d: Dimensions, head: Path = HEAD) -> LensPlate:
    """Return the plate of a head file; SpecError for a head without a layout, or with unlike or round lenses."""
    optics = load_head(head).optics
    element = None if optics is None else optics.element
    if optics is None or element is None or element.layout is None or element.aperture_um is not None:
        raise SpecError(f"{head.name} has no plate of lenslets without gaps", "Give a head with such a layout.")
    lenses = np.array(element.lenses) / 1000
    if np.ptp(lenses[:, 2]):
        raise SpecError(f"{element.layout} has lenses of several focal lengths", "The dents of one ball have one.")
    return LensPlate(
        layout=element.layout,
        centres_mm=-lenses[:, :2],
        focal_mm=float(lenses[0, 2]),
        index=element.index,
        distance_mm=optics.diffuser_to_sensor_um / 1000,
        thick_mm=element.thickness_um / 1000,
        wide_mm=d.bought.diffuser_mm,
        iris_mm=optics.iris_um / 1000,
        play_mm=d.fit.slide_mm / 2,
    )


def height_map(plate: LensPlate) -> NDArray[np.uint16]:
    """Return the heights above the rim in counts of `COUNT_MM`, (rows, cols), seen from the lenses' side, up is up."""
    half = ceil(plate.half_mm / STEP_MM)
    along = (np.arange(2 * half) + 0.5 - half) * STEP_MM
    places = np.stack(np.meshgrid(along, -along), axis=-1).reshape(-1, 2)
    counts = np.rint(plate.height_mm(places) / COUNT_MM)
    return np.asarray(counts.reshape(2 * half, 2 * half), np.uint16)


def export_plate(plate: LensPlate, folder: Path) -> list[Path]:
    """Write the plate as STEP, and its height map as a PNG file of 16 bits that states its scale; return the files."""
    stem = folder / plate.layout.replace("_", "-")
    step, image = stem.with_suffix(".step"), stem.with_name(f"{stem.name}-height.png")
    export_step(plate.solid(), step)
    scale = PngInfo()
    scale.add_text(
        "Description",
        f"height above the rim, {1e6 * COUNT_MM:g} nm a count; {1000 * STEP_MM:g} um a pixel; seen from the lenses' "
        f"side; R {plate.radius_mm:.3f} mm, vertices at {1000 * plate.vertex_mm:.0f} um",
    )
    Image.fromarray(height_map(plate)).save(image, dpi=(25.4 / STEP_MM,) * 2, pnginfo=scale)
    return [step, image]
