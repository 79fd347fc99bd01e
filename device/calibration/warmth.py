"""How the dark current of one head grows with its temperature, from all dark steps that its archive holds.

A silicon sensor's doubles every 6 to 8 C. Each calibration adds one point to the line of log2(dark current) over
temperature; from two points that are apart enough the law is known.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from device.calibration.archive import Archive, Kept
from device.errors import CalibrationError
from device.values import Image

REFERENCE_C = 25.0
LEAST_APART_C = 3.0
LEAST_E_PER_S = 0.5  # three times what a dark step of a sensor without any would seem to have
FASTEST_C, SLOWEST_C = 4.0, 12.0  # per doubling; beyond, something else than warmth has changed


@dataclass(frozen=True)
class Dark:
    """One dark step: how warm it was, and electrons per second of a pixel in the mean."""

    warm_c: float
    e_per_s: float


@dataclass(frozen=True)
class Warmth:
    """The law: `reference_e_per_s` at 25 C, twice that every `doubling_c`; from so many dark steps."""

    reference_e_per_s: float
    doubling_c: float
    steps: int

    def at(self, warm_c: float) -> float:
        """Electrons per second at a temperature."""
        return float(self.reference_e_per_s * 2 ** ((warm_c - REFERENCE_C) / self.doubling_c))

    @property
    def is_plausible(self) -> bool:
        """Whether this can be the warmth of silicon."""
        return FASTEST_C <= self.doubling_c <= SLOWEST_C

    @property
    def figures(self) -> dict[str, float]:
        """As the manifest keeps them."""
        law = {"dark_25c_e_per_s": self.reference_e_per_s, "dark_doubling_c": self.doubling_c}
        return law | {"dark_law_steps": float(self.steps)}


def fitted_warmth(darks: Iterable[Dark]) -> Warmth | None:
    """The line through these steps; None where they are too few, or too near each other in temperature."""
    known = [dark for dark in darks if isfinite(dark.warm_c) and dark.e_per_s > LEAST_E_PER_S]
    if len(known) < 2 or np.ptp([dark.warm_c for dark in known]) < LEAST_APART_C:
        return None
    warmer_c = np.array([dark.warm_c - REFERENCE_C for dark in known])
    per_c, reference = np.polyfit(warmer_c, np.log2([dark.e_per_s for dark in known]), 1)
    return Warmth(float(2**reference), float(1 / per_c) if per_c else np.inf, len(known))


def dark_steps(archive: Archive, serial: str) -> Sequence[Dark]:
    """The dark steps of one head's calibrations; what is damaged tells nothing."""
    found = []
    for id in archive.ids():
        try:
            said = archive.load(id).provenance
        except CalibrationError:
            continue
        figures = dict(said.figures)
        if said.serial == serial and "dark_c" in figures:
            found.append(Dark(figures["dark_c"], figures["dark_e_per_s"]))
    return found


def dark_dn_at(kept: Kept, warm_c: float) -> Image | None:
    """The dark frame of a calibration, (rows, cols), DN, as it is at another temperature; None where it has no law."""
    figures, sensor, dark_dn = dict(kept.provenance.figures), kept.calibration.sensor, kept.calibration.dark_dn
    if "dark_doubling_c" not in figures or dark_dn is None or sensor.gain_e_per_dn is None:
        return None
    law = Warmth(figures["dark_25c_e_per_s"], figures["dark_doubling_c"], int(figures["dark_law_steps"]))
    more_e = (law.at(warm_c) - law.at(figures["dark_c"])) * figures["dark_map_s"]
    return np.asarray(dark_dn + np.float32(more_e / sensor.gain_e_per_dn))
