"""Dispersion of optical glasses: refractive index by a Sellmeier or a Laurent series (OPTICS.md 6.2)."""

from math import sqrt
from typing import Literal

from pydantic import Field

from device.config.toml_file import Table
from device.errors import SpecError


class Glass(Table):
    """One glass: series, coefficients, and the range of wavelengths in which they hold (`from_um` to `to_um`).

    `sellmeier`: n^2 = 1 + sum over k of b_k w^2 / (w^2 - c_k), w in um, `coefficients` b1, b2, b3, c1, c2, c3 (um^2).
    `laurent`: n^2 = a0 + a1 w^2 + a2 w^-2 + a3 w^-4 + a4 w^-6 + a5 w^-8, `coefficients` a0 to a5.
    """

    series: Literal["sellmeier", "laurent"]
    coefficients: tuple[float, float, float, float, float, float]
    from_um: float = Field(default=0.4, gt=0)
    to_um: float = Field(default=1.0, gt=0)
    source: str = Field(min_length=8)

    def index(self, wavelength_um: float) -> float:
        """Return the refractive index against air; SpecError outside the range of the coefficients."""
        if not self.from_um <= wavelength_um <= self.to_um:
            raise SpecError(
                f"a wavelength of {wavelength_um:g} um is outside {self.from_um:g} to {self.to_um:g} um",
                "Choose a wavelength for which the glass's coefficients hold.",
            )
        square = wavelength_um**2
        if self.series == "sellmeier":
            pairs = zip(self.coefficients[:3], self.coefficients[3:], strict=True)
            return sqrt(1 + sum(b * square / (square - c) for b, c in pairs))
        first, rising, *falling = self.coefficients
        return sqrt(first + rising * square + sum(a / square ** (k + 1) for k, a in enumerate(falling)))
