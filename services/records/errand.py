"""Why a picture is taken: for which slot of which visit, and what is kept in one step with it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from device.values import Capture

Beside = Callable[[Session, Capture], None]
Permit = Callable[[], None]


def permit_test_picture() -> None:
    """Allow light that belongs to no visit: a test picture, or aiming for one."""


@dataclass(frozen=True)
class Errand:
    """Target of a capture: visit, slot, field, tries so far, permitted retakes; `beside` writes rows with it.

    `permit` is called right before the light: it raises ConsentMissing or ConsentDeclined where the visit does not
    allow any. Without a visit the picture is a test picture.
    """

    visit: str | None = None
    slot: str | None = None
    tries: int = 0
    retakes: int = 2
    field: str | None = None
    beside: Beside | None = None
    permit: Permit = permit_test_picture

    @property
    def facts(self) -> dict[str, Any]:
        """What the report of the capture says of it."""
        return {"visit": self.visit, "slot": self.slot}

    @property
    def is_test(self) -> bool:
        """Whether the picture belongs to no visit, and never will."""
        return self.visit is None


NO_ERRAND = Errand()
