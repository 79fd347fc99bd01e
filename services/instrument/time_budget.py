"""Time budgets of a picture, selectable by name, and the shutdown timeout that follows from them.

Single source: the timeouts of the exam, `TimeoutStopSec=` of the unit and the health check of speed agree with it.
"""

from typing import Literal

from services.health.thresholds import MAX_LATENESS_S
from services.records.capture import BUDGET_S

Pace = Literal["quick", "standard", "best"]
PACES_S: dict[Pace, float] = {"quick": 1.0, "standard": BUDGET_S, "best": 30.0}
MAX_IN_PROGRESS = 2  # captures in progress at once: one in refinement, and one more that is exposed
SHUTDOWN_TIMEOUT_S = MAX_IN_PROGRESS * (
    max(PACES_S.values()) + MAX_LATENESS_S
)  # from the shutdown request until every capture in progress is stored
