"""Real lenses of the light path: makers' radii, thicknesses and glasses as surfaces of a ray trace."""

from typing import Self

from pydantic import Field, model_validator

from device.config.toml_file import Table
from device.errors import SpecError
from device.optics.glass import Glass
from device.optics.ray_trace import Surface

REVERSED = " reversed"
CLEAR = 0.9  # share of a lens's diameter that is its clear aperture, by the maker's data


class LensSpec(Table):
    """One lens: radii of its surfaces, thicknesses and glasses between them, and the catalogue's focal distances."""

    radii_mm: tuple[float, ...] = Field(min_length=2)
    thick_mm: tuple[float, ...]
    glasses: tuple[str, ...]
    diameter_mm: float = Field(gt=0)
    focal_mm: float
    back_mm: float
    focal_at_um: float = Field(gt=0)
    source: str = Field(min_length=8)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        """Raise ValueError unless each space between two surfaces has a thickness and a glass."""
        spaces = len(self.radii_mm) - 1
        if not len(self.thick_mm) == len(self.glasses) == spaces or min(self.thick_mm) <= 0 or 0 in self.radii_mm:
            raise ValueError(f"{spaces} thicknesses above 0 and glasses belong between {spaces + 1} radii other than 0")
        return self

    def turned(self) -> Self:
        """Return the lens with its last surface first."""
        radii = tuple(-radius for radius in reversed(self.radii_mm))
        return self.model_copy(
            update={"radii_mm": radii, "thick_mm": self.thick_mm[::-1], "glasses": self.glasses[::-1]}
        )


class LayoutSpec(Table):
    """Order of the lenses: each group by names, "NAME reversed" for a turned lens, and the distances of a ray trace."""

    first: tuple[str, ...] = Field(min_length=1)
    second: tuple[str, ...] = Field(min_length=1)
    gap_mm: float = Field(ge=0)
    eye_lens: str
    pupil_to_eye_lens_mm: float = Field(ge=0)
    retina_radius_mm: float = Field(gt=0)
    plate_mm: float = Field(gt=0)
    plate_glass: str


def named_glass(glasses: dict[str, Glass], name: str, user: str) -> Glass:
    """Return a glass by name; SpecError names the lens whose glass is missing."""
    if name not in glasses:
        raise SpecError(
            f"glass {name!r} of {user} is not in the file",
            f'Add a table [glass."{name}"], or choose one of {", ".join(sorted(glasses))}.',
        )
    return glasses[name]


def lens_surfaces(
    lenses: dict[str, LensSpec], glasses: dict[str, Glass], name: str, wavelength_um: float, at_mm: float = 0.0
) -> tuple[Surface, ...]:
    """Return the surfaces of a lens ("NAME" or "NAME reversed") with its first vertex at `at_mm`.

    SpecError for a lens or a glass that the file does not have.
    """
    plain = name.removesuffix(REVERSED)
    if plain not in lenses:
        raise SpecError(f"lens {plain!r} is not in the file", f"Choose one of {', '.join(sorted(lenses))}.")
    lens = lenses[plain].turned() if name.endswith(REVERSED) else lenses[plain]
    indices = [named_glass(glasses, glass, plain).index(wavelength_um) for glass in lens.glasses] + [1.0]
    places = [at_mm + sum(lens.thick_mm[:k]) for k in range(len(lens.radii_mm))]
    return tuple(
        Surface(at, radius, index, CLEAR * lens.diameter_mm, name=f"surface {k + 1} of {name}")
        for k, (at, radius, index) in enumerate(zip(places, lens.radii_mm, indices, strict=True))
    )
