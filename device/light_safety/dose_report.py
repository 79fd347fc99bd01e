"""Light figures of one exposure, for its report."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from device.values import DESCRIBED, OMITTED_IF_EMPTY, Number


@dataclass(frozen=True)
class DoseReport:
    """Light of one exposure; None and empty where there is no figure."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    dose_j_per_cm2: Number | None = None
    """Light dose of this exposure at the retina in J/cm2."""

    dose_24h_j_per_cm2: Mapping[str, Number] = field(default_factory=dict)
    """Light dose of each eye in the last 24 hours in J/cm2, with this exposure."""

    dose_stop_j_per_cm2: Number | None = None
    """Dose in 24 hours at which an eye gets no more light, in J/cm2."""

    dose_high: tuple[str, ...] = ()
    """Eyes whose dose is above the warning."""

    limits_unchecked: tuple[str, ...] = field(default=(), metadata=OMITTED_IF_EMPTY)
    """Names of the light limits that were not compared with the purchased standard."""
