"""How long a picture may take: the paces that a person can choose, and what follows for whoever waits for the end.

The one place that says so: the exam's patience, the unit's `TimeoutStopSec=` and the check of speed agree with it.
"""

from typing import Literal

from services.health.checks import LATE_S

Pace = Literal["quick", "standard", "best"]
PACES_S: dict[Pace, float] = {"quick": 1.0, "standard": 5.0, "best": 30.0}
BUDGET_S = PACES_S["standard"]
SEATS = 2  # pictures in the making at once: one that is refined, and one more that is exposed
LAST_S = SEATS * (max(PACES_S.values()) + LATE_S)  # from the wish to end until every picture under way is kept
