"""Light budget of a head as a chain of factors from the LED to the electron, each with uncertainty and source.

The product of the factors is the mean number of electrons in a cell of 10 um on the sensor, of all frames of a picture
together. It is `photon_budget` taken apart, times the share of the ring that the eye's pupil passes (OPTICS.md 4.6).
Where the head file has a measured irradiance, the LED's power is what gives it, and the parts before the cornea have no
uncertainty of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi, prod, radians, sin, sqrt, tan
from typing import Literal

import numpy as np

from device.optics import field_extent
from device.optics.budget import Design, lit_area_cm2
from device.optics.illumination import PLANCK_LIGHT_J_M, half_cone_deg
from device.optics.matrix import ring

CELL_UM = 10.0
ENOUGH_E = 5000.0  # electrons per cell of 10 um that a picture of vessels should have: an estimate by eye, no source
METER_SPREAD = 0.13  # of a measured ring: 1.3, the least guard factor, in 95 %
DRAWS = 20000
CONE = "share in the cone"
Cause = Literal["safety", "LED", "coupling", "polarisers", "splitter", "pupil", "eye", "pixel", "exposure"]


@dataclass(frozen=True)
class Factor:
    """One factor of a chain: value and unit, standard deviation of its logarithm, what it belongs to, source.

    `ideal` is the largest value that it could have with other parts, None where no part changes it.
    """

    name: str
    value: float
    unit: str
    spread: float
    cause: Cause
    source: str
    ideal: float | None = None


@dataclass(frozen=True)
class Spread:
    """Median and 5 % and 95 % quantiles of a simulated quantity."""

    median: float
    low: float
    high: float


def chain(design: Design, level: float = 1.0, frames: int = 1) -> tuple[Factor, ...]:
    """Return the factors of a design at `level` (0 to 1] of full drive, over `frames` exposures of one picture."""
    lamp = _lamp(design, level)
    if design.radiometry is not None and design.measured is not None:
        lamp = [replace(factor, spread=0.0) for factor in lamp]
        source = f"measured: {design.radiometry.measured}"
        lamp[2] = replace(lamp[2], spread=METER_SPREAD, source=source)
    return (*lamp, *_into_eye(design), *_from_eye(design), *_sensor(design, frames))


def cornea_mw(factors: Sequence[Factor]) -> float:
    """Return the power of the whole ring at the eye, mW, of which the pupil passes a share."""
    return product(to_cornea(factors))


def to_cornea(factors: Sequence[Factor]) -> Sequence[Factor]:
    """Return the first factors of a chain, up to the power of the whole ring at the eye."""
    return factors[: [factor.name for factor in factors].index("share in the pupil")]


def product(factors: Sequence[Factor]) -> float:
    """Return the product of the factors: electrons in a cell of 10 um where they are a whole chain."""
    return prod(factor.value for factor in factors)


def simulated(factors: Sequence[Factor], draws: int = DRAWS, seed: int = 0) -> Spread:
    """Return the spread of the product where each factor is log-normal with its standard deviation, by Monte Carlo."""
    rng = np.random.default_rng(seed)
    spreads = np.array([factor.spread for factor in factors])
    logs = rng.standard_normal((draws, len(factors))) @ spreads
    low, median, high = np.quantile(product(factors) * np.exp(logs), (0.05, 0.5, 0.95))
    return Spread(float(median), float(low), float(high))


def log_sd(factors: Sequence[Factor]) -> float:
    """Return the standard deviation of the logarithm of the product of independent factors."""
    return sqrt(sum(factor.spread**2 for factor in factors))


def possible_gains(factors: Sequence[Factor]) -> dict[Cause, float]:
    """Return by cause how many times more light its ideal values would give, the largest first."""
    found: dict[Cause, float] = {}
    for factor in factors:
        if factor.ideal is not None:
            found[factor.cause] = found.get(factor.cause, 1.0) * factor.ideal / factor.value
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def retina_mw_per_cm2(factors: Sequence[Factor]) -> float:
    """Return the irradiance of the retina, mW/cm2: the product of the first factors of a chain, up to the retina."""
    names = [factor.name for factor in factors]
    return product(factors[: names.index("lit retina") + 1])


def _lamp(design: Design, level: float) -> list[Factor]:
    half_deg = half_cone_deg(design.optics.field_deg, design.relay.angular_magnification)
    places = "ring of hardware/optics.toml" if design.chain == design.path.ring else "head file"
    return [
        Factor("drive", level, "", 0.0, "safety", "full drive, or what the light limits permit", 1.0),
        Factor("LEDs", len(ring(design.chain)), "", 0.0, "LED", places),
        Factor("power of an LED", design.led.power_mw, "mW", 0.35, "LED", "estimate; a factor of two until measured"),
        Factor(
            CONE,
            sin(radians(half_deg)) ** 2,
            "",
            0.1,
            "coupling",
            f"sin^2 of {half_deg:.1f} deg, Lambertian emitter",
            1.0,
        ),
        Factor("polariser", 0.42, "", 0.1, "polarisers", "film, unpolarised light", 1.0),
        Factor("splitter to the eye", 0.5, "", 0.05, "splitter", "50:50 plate", 1.0),
        Factor("relay to the eye", 0.9, "", 0.03, "coupling", "four doublets, coated", 1.0),
    ]


def _into_eye(design: Design) -> list[Factor]:
    return [
        Factor(
            "share in the pupil",
            design.share_in_pupil,
            "",
            0.1,
            "coupling",
            f"image of ring and emitter in a pupil of {design.pupil_mm:g} mm",
            1.0,
        ),
        Factor(
            "lit retina",
            1 / lit_area_cm2(design.optics.field_deg, design.eye_mm),
            "/cm2",
            0.1,
            "eye",
            f"{design.optics.field_deg:g} deg, f = {design.eye_mm:g} mm",
        ),
    ]


def _from_eye(design: Design) -> list[Factor]:
    iris_cm2 = pi * (design.relay.iris_at_eye_mm / 20) ** 2
    pupil_cm2 = pi * (design.pupil_mm / 20) ** 2
    lit_sr = pi * tan(radians(design.optics.field_deg / 2)) ** 2
    return [
        Factor(
            "radiance of the fundus",
            design.led.reflectance / pi,
            "/sr",
            0.3,
            "eye",
            "Delori and Pflibsen 1989, Table I; persons differ by 25 to 50 %",
        ),
        Factor(
            "iris at the eye",
            iris_cm2,
            "cm2",
            0.03,
            "pupil",
            f"{design.relay.iris_at_eye_mm:.2f} mm wide",
            max(pupil_cm2, iris_cm2),
        ),
        Factor("solid angle of the field", lit_sr, "sr", 0.02, "eye", "lit area over the square of f"),
        Factor("relay from the eye", 0.9, "", 0.03, "coupling", "four doublets, coated", 1.0),
        Factor("splitter from the eye", 0.5, "", 0.05, "splitter", "50:50 plate", 1.0),
        Factor("crossed polariser", 0.40, "", 0.2, "polarisers", "of depolarised light; an estimate", 1.0),
    ]


def _sensor(design: Design, frames: int) -> list[Factor]:
    image_cells = pi * (field_extent.extent_mm(design.relay, design.optics.field_deg) * 1000 / 2 / CELL_UM) ** 2
    photons_per_mj = 1e-3 * design.led.wavelength_um * 1e-6 / PLANCK_LIGHT_J_M
    return [
        Factor("photons", photons_per_mj, "/mJ", 0.01, "eye", f"h c at {1000 * design.led.wavelength_um:.0f} nm"),
        Factor("quantum efficiency", design.led.quantum_efficiency, "e-", 0.1, "pixel", "the paper's sensor", 1.0),
        Factor("cell of 10 um", 1 / image_cells, "", 0.03, "pixel", "of a disc of the width d + 2 s"),
        Factor("exposure", design.exposure_s, "s", 0.0, "exposure", "head file", max(design.exposure_s, 0.2)),
        Factor("frames", frames, "", 0.0, "exposure", "of one picture", max(frames, 4)),
    ]
