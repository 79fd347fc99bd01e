"""Dark-current model of one head: dark current over temperature, fitted to all dark steps in its archive.

The dark current of a silicon sensor doubles every 6 to 8 C. Each calibration adds one point to the line of log2(dark
current) over temperature; two points at sufficiently different temperatures define it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from device.calibration.archive import Archive
from device.errors import CalibrationError

REFERENCE_C = 25.0
MIN_TEMPERATURE_RANGE_C = 3.0
MIN_E_PER_S = 0.5  # three times the apparent dark current of a sensor without any
MIN_DOUBLING_C, MAX_DOUBLING_C = 4.0, 12.0  # per doubling; outside, the cause is not temperature


@dataclass(frozen=True)
class DarkStep:
    """One dark step of a calibration: temperature, and mean dark current per pixel, electrons per second."""

    temperature_c: float
    e_per_s: float


@dataclass(frozen=True)
class DarkCurrentModel:
    """Exponential model: `reference_e_per_s` at 25 C, doubling every `doubling_c`; fitted to `steps` dark steps."""

    reference_e_per_s: float
    doubling_c: float
    steps: int

    @property
    def is_plausible(self) -> bool:
        """Return whether the dark current doubles every 4 to 12 C, as is plausible for silicon."""
        return MIN_DOUBLING_C <= self.doubling_c <= MAX_DOUBLING_C

    @property
    def figures(self) -> dict[str, float]:
        """Return the model as named figures of a calibration's manifest."""
        model = {"dark_25c_e_per_s": self.reference_e_per_s, "dark_doubling_c": self.doubling_c}
        return model | {"dark_law_steps": float(self.steps)}


def fit_dark_current(darks: Iterable[DarkStep]) -> DarkCurrentModel | None:
    """Return the model of these steps; None with fewer than two above MIN_E_PER_S, or a range below 3 C."""
    known = [dark for dark in darks if isfinite(dark.temperature_c) and dark.e_per_s > MIN_E_PER_S]
    if len(known) < 2 or np.ptp([dark.temperature_c for dark in known]) < MIN_TEMPERATURE_RANGE_C:
        return None
    warmer_c = np.array([dark.temperature_c - REFERENCE_C for dark in known])
    per_c, reference = np.polyfit(warmer_c, np.log2([dark.e_per_s for dark in known]), 1)
    return DarkCurrentModel(float(2**reference), float(1 / per_c) if per_c else np.inf, len(known))


def dark_steps(archive: Archive, serial: str) -> Sequence[DarkStep]:
    """Return the dark steps, with a known temperature, of one head's calibrations; damaged calibrations are skipped."""
    found = []
    for id in archive.ids():
        try:
            provenance = archive.load(id).provenance
        except CalibrationError:
            continue
        figures = dict(provenance.figures)
        if provenance.serial == serial and "dark_c" in figures:
            found.append(DarkStep(figures["dark_c"], figures["dark_e_per_s"]))
    return found
