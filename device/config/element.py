"""Element at the iris of a head, table [optics.element]: a diffuser, or lenslets with the file of their layout."""

import csv
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, model_validator

from device.config.shipped_heads import HEADS
from device.config.toml_file import Table
from device.user_files import read_text

COLUMNS = ("right_um", "down_um", "focal_um")
PLACES = 320  # along the iris, on which the cells of the lenses are measured
CLOSEST_UM = 20.0  # between two centres: closer ones are one lens listed twice

Lenses = tuple[tuple[float, float, float], ...]


class ElementSpec(Table):
    """Element at the iris: a random surface with a slope and a correlation length, or lenses that focus on the sensor.

    `lenses` are the vertices of the lenses (right, down on the sensor) and their focal lengths in air, um, unless they
    are given those of `layout`: a shipped layout, or a CSV file beside the head file. Each place belongs to the nearest
    vertex (OPTICS.md 2.8). `aperture_um` is the diameter of each lens, None: its whole cell; the gaps beside the lenses
    are black or clear. `index`, `abbe` and `thickness_um` are of the plate, whose vertices stand
    `optics.diffuser_to_sensor_um` before the sensor.
    """

    kind: Literal["diffuser", "lenslets"] = "diffuser"
    slope_fwhm_deg: float = Field(default=0.5, gt=0, lt=20)  # of a diffuser
    correlation_um: float = Field(default=70.0, gt=0)  # of a diffuser
    layout: str | None = None  # a name such as lenslets_22, or a CSV file of right_um, down_um, focal_um
    lenses: Lenses = ()
    aperture_um: float | None = Field(default=None, gt=0)
    gaps: Literal["black", "clear"] = "black"
    flat_field: bool = False  # lenses of several surfaces: in focus over the whole field
    index: float = Field(default=1.5, gt=1, lt=2.5)
    abbe: float = Field(default=55.0, ge=15, le=100)
    thickness_um: float = Field(default=1000.0, gt=0, le=10000)
    focal_at_um: float = Field(default=0.55, gt=0.3, lt=1.2)  # wavelength for which the focal lengths hold

    @model_validator(mode="before")
    @classmethod
    def _with_layout(cls, values: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        """Add the lenses of the named file; ValueError for a file that is missing or is no layout."""
        name = values.get("layout")
        if name is None or "lenses" in values:
            return values
        folder = Path() if info.context is None else Path(info.context["folder"])
        path = folder / str(name) if str(name).endswith(".csv") else HEADS / f"{name}.csv"
        if not path.is_file():
            raise ValueError(f"there is no layout {path}; give the path of a CSV file with {', '.join(COLUMNS)}")
        return {**values, "lenses": read_layout(path)}

    @model_validator(mode="after")
    def _check_lenses(self) -> "ElementSpec":
        """Raise ValueError for lenslets without lenses, a diffuser with lenses, or lenses that cannot be made."""
        if (self.kind == "lenslets") != bool(self.lenses):
            raise ValueError('lenses go with kind = "lenslets", which needs the key layout: the path of a CSV file')
        for number, (right_um, down_um, focal_um) in enumerate(self.lenses, 1):
            if focal_um <= 0:
                raise ValueError(f"lens {number} has the focal length {focal_um:g} um; allowed: above 0")
            for other, (beside_um, below_um, _) in enumerate(self.lenses[: number - 1], 1):
                if np.hypot(right_um - beside_um, down_um - below_um) < CLOSEST_UM:
                    raise ValueError(
                        f"the centres of lenses {other} and {number} overlap; allowed: {CLOSEST_UM:g} um apart"
                    )
        return self

    def check_iris(self, iris_um: float) -> None:
        """Raise ValueError for a lens that no light of the iris meets, or whose sag is more than the thickness."""
        for number, half_um in enumerate(half_widths_um(self.lenses, iris_um), 1):
            if half_um == 0:
                raise ValueError(f"lens {number} stands outside the iris of {iris_um:g} um: no light meets its cell")
            sag_um = half_um**2 / (2 * (self.index - 1) * self.lenses[number - 1][2])
            if sag_um >= self.thickness_um:
                raise ValueError(f"lens {number} has a sag of {sag_um:.0f} um; thickness_um = {self.thickness_um:g}")


def read_layout(path: Path) -> Lenses:
    """Return the lenses in a CSV file; ValueError names the line that is wrong."""
    rows = csv.reader(read_text(path).splitlines())
    if tuple(next(rows, ())) != COLUMNS:
        raise ValueError(f"{path}: the first line is {','.join(COLUMNS)}")
    found = []
    for line, row in enumerate(rows, 2):
        try:
            right_um, down_um, focal_um = map(float, row)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: three numbers, {', '.join(COLUMNS)}, not {row}") from error
        found.append((right_um, down_um, focal_um))
    return tuple(found)


@cache
def half_widths_um(lenses: Lenses, iris_um: float) -> tuple[float, ...]:
    """Return the largest offset, along either axis, of a place of the iris from the lens to which it belongs, um.

    One number for each lens; 0 for a lens to which no place of the iris belongs.
    """
    if not lenses:
        return ()
    places_um, step_um = iris_places_um(iris_um)
    owners = nearest(places_um, lenses)
    halves = []
    for number, (right_um, down_um, _) in enumerate(lenses):
        cell = places_um[owners == number] - (right_um, down_um)
        halves.append(float(np.abs(cell).max()) + step_um if cell.size else 0.0)
    return tuple(halves)


def iris_places_um(iris_um: float, count: int = PLACES) -> tuple[NDArray[np.float64], float]:
    """Return places (right, down) of the iris, um, (places, 2), `count` along its diameter, and their distance, um."""
    step_um = iris_um / count
    along = (np.arange(count) + 0.5) * step_um - iris_um / 2
    pairs = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return pairs[np.hypot(*pairs.T) <= iris_um / 2], step_um


def nearest(places_um: NDArray[np.float64], lenses: Lenses) -> NDArray[np.intp]:
    """Return the number of the lens whose vertex is nearest to each place, (places,)."""
    centres = np.array(lenses, np.float64).reshape(-1, 3)[:, :2]
    squared = (centres**2).sum(axis=1) - 2 * places_um @ centres.T
    return np.asarray(squared.argmin(axis=1))
