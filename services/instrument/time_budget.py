"""Time budget of a picture: its definition, the choices by name, and the shutdown timeout that follows from them.

A time budget (`budget_s`, also of `diffuscope reconstruct` and `archive`) counts from the last read-out of a press, or
from the loaded frames with their plans made, to the final picture in memory. Joining of the burst, refraction and
colour are included; exposures, planning and storage are not. Time that the instrument spends on another press does not
count. A picture misses its deadline if it is made later by more than MAX_OVERRUN (services/health/thresholds.py).
"""

from dataclasses import replace
from typing import Literal

from services.health.thresholds import MAX_LATENESS_S
from services.records.capture import BUDGET_S
from services.records.capture_target import CaptureTarget

Pace = Literal["grey", "quick", "standard"]
PACES_S: dict[Pace, float] = {"grey": 0.26, "quick": 1.0, "standard": BUDGET_S}  # 0.26: the paper's
CYLINDER_S = 2.0  # below it the cylinder of the refraction is not estimated: half a second of a second core
ONE_FRAME_S = 0.5  # below it a press takes one lit frame, in green, and its refraction is not estimated
MAX_IN_PROGRESS = 2  # captures in progress at once: one in refinement, and one more that is exposed
MAX_STORAGE_S = 25.0  # longest storage of a capture: a worn card
SHUTDOWN_TIMEOUT_S = MAX_IN_PROGRESS * (
    max(PACES_S.values()) + MAX_LATENESS_S + MAX_STORAGE_S
)  # from the shutdown request until every capture in progress is stored


def is_of_one_frame(budget_s: float) -> bool:
    """Return whether a press with this time budget takes one lit frame."""
    return budget_s < ONE_FRAME_S


def has_time_for_cylinder(budget_s: float) -> bool:
    """Return whether a press with this time budget estimates the cylinder of the refraction."""
    return budget_s >= CYLINDER_S


def within_budget(target: CaptureTarget, budget_s: float) -> CaptureTarget:
    """Return the target with the frames that the time budget leaves time for."""
    return replace(target, frames=1, colours=()) if is_of_one_frame(budget_s) else target
