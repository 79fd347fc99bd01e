"""Why a picture is taken: for which slot of which visit, and what is kept in one step with it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from device.values import Capture

Beside = Callable[[Session, Capture], None]


@dataclass(frozen=True)
class Errand:
    """A slot of a visit and its part, how often it was tried and may be tried, and what `beside` writes with it."""

    visit: str | None = None
    slot: str | None = None
    tries: int = 0
    retakes: int = 2
    field: str | None = None
    beside: Beside | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """What the report of the capture says of it."""
        return {"visit": self.visit, "slot": self.slot}


NO_ERRAND = Errand()
