"""Pigments of a drawn retina, by the Beer-Lambert law: melanin, macular pigment and blood change its colours.

Each is relative to the eye of `fundus.py`, whose reflectances and contrasts are those of OPTICS.md 4.1: a quantity of
1 (melanin 0) leaves every value as it is. OPTICS.md 4.8 has formulas and sources.
"""

from dataclasses import dataclass
from math import exp

from device.values import Colour

# Natural logarithm of the reflectance per standard deviation of melanin between persons (Delori and Pflibsen 1989).
MELANIN: dict[Colour, float] = {"red": 0.41, "green": 0.22, "blue": 0.22}
# Absorbance of macular pigment at the LED over that at its peak of 460 nm (Bone, Landrum and Cains 1992).
MACULAR: dict[Colour, float] = {"red": 0.0, "green": 0.15, "blue": 0.95}
MACULAR_PEAK_DENSITY = 0.35  # optical density of the mean eye at 460 nm, at the fovea, single pass
AT_FOVEA = 1.45  # darkening at the fovea over `depth`, the broader of two Gaussians (fundus.py)


@dataclass(frozen=True)
class Pigments:
    """Pigments of one eye.

    `melanin`: of the fundus, in standard deviations of a population above its mean, -3 to 3. `macular`: macular
    pigment, and `haemoglobin`: of the blood, both relative to the mean eye, 0 to 3.
    """

    melanin: float = 0.0
    macular: float = 1.0
    haemoglobin: float = 1.0

    def reflectance(self, colour: Colour, mean_reflectance: float) -> float:
        """Return the reflectance of this eye's tissue; `mean_reflectance` is the mean over persons."""
        return mean_reflectance * exp(-MELANIN[colour] * self.melanin) if self.melanin else mean_reflectance

    def choroid(self, colour: Colour, contrast: float) -> float:
        """Return the contrast of the choroidal vessels, which melanin in front of them covers in a double pass."""
        return contrast if self.melanin == 0 else contrast * exp(-MELANIN[colour] * self.melanin)

    def macula(self, colour: Colour, depth: float) -> float:
        """Return the darkening around the fovea; `depth` is that of the mean eye, melanin of the fovea included.

        At the fovea itself the reflectance is 1 - AT_FOVEA times this, to which the law applies; a negative value is a
        bright fovea.
        """
        if self.macular == 1:
            return depth
        passes = 10 ** (-2 * MACULAR_PEAK_DENSITY * MACULAR[colour] * (self.macular - 1))
        return (1 - (1 - AT_FOVEA * depth) * passes) / AT_FOVEA

    def blood(self, contrast: float) -> float:
        """Return the contrast of a vessel or haemorrhage, 0 to 1: its absorbance is in proportion to haemoglobin."""
        return contrast if self.haemoglobin == 1 else 1 - (1 - contrast) ** self.haemoglobin
