"""Light figures of one exposure, for its report."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class DoseReport:
    """Light of one exposure: its dose, the dose of each eye in 24 h, the limit (all J/cm2), eyes above the warning.

    `limits_unchecked`: names of the limits that were not compared with the purchased standard. None and empty where
    there is no figure.
    """

    dose_j_per_cm2: float | None = None
    dose_24h_j_per_cm2: Mapping[str, float] = field(default_factory=dict)
    dose_stop_j_per_cm2: float | None = None
    dose_high: tuple[str, ...] = ()
    limits_unchecked: tuple[str, ...] = ()
